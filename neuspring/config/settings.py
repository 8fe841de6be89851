"""The whole configuration: one benchmark, with a section for each part of the platform. Nothing heavy is imported here."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, StringConstraints

from neuspring.config.data import Toy
from neuspring.config.effort import EFFORTS, Effort, sizes
from neuspring.config.extensions import Baselines, with_extensions
from neuspring.config.images import Images
from neuspring.config.parse import json_value, merge, nested, parse, plain, read_yaml
from neuspring.config.perception import Perception
from neuspring.config.search import Search
from neuspring.config.simulation import ReleasedQuirks, SimulationSettings
from neuspring.config.tuning import Tune
from neuspring.config.twin import Fit, Losses
from neuspring.core.section import Count, Name, SettingsSection
from neuspring.core.text import refuse_password

Device = Annotated[int, Field(ge=0)] | Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9/._-]*$")]


@dataclass(frozen=True, kw_only=True)
class Gpus(SettingsSection):
    """GPUs of this machine that jobs lease. On a cluster its scheduler chooses them, and `batch` alone is read."""

    devices: Literal["all"] | tuple[Device, ...] = "all"
    """Indices or UUIDs of the GPUs; all: those of CUDA_VISIBLE_DEVICES, or all of the machine where it is not set."""
    jobs_per_gpu: Count = 1
    """Number of jobs that share a GPU; use 1 for timings that can be compared."""
    batch: Count | Literal["auto"] = "auto"
    """Most searches, or fits, of all scenarios and seeds that one job does together, with shared launches; auto: on GPUs as many as
    give each GPU a job, 16 at most, on a CPU 1. 1: jobs of their own, but for the fits of a scenario (`twins_per_launch`)."""

    def __post_init__(self) -> None:
        if self.devices != "all" and (not self.devices or len(set(map(str, self.devices))) != len(self.devices)):
            raise ValueError(f"devices: at least one, each once, is required, received {list(self.devices)}")


def _seed_list(value: Any) -> Any:
    """`--config seeds=0,1,2` arrives as text, `seeds=0` as a number, `seeds=[0,1,2]` as a list of text."""
    entries = value.split(",") if isinstance(value, str) else [value] if type(value) is int else value
    if not isinstance(entries, list):
        return value
    try:
        return tuple(int(entry) if isinstance(entry, str) else entry for entry in entries)
    except ValueError as error:
        raise ValueError("integers separated by commas are required, as in seeds=0,1,2") from error


Seeds = Annotated[tuple[Annotated[int, Field(ge=0)], ...], BeforeValidator(_seed_list)]


@dataclass(frozen=True, kw_only=True)
class Tracking(SettingsSection):
    """MLflow, an index of the runs. The files are the record."""

    enabled: bool = True
    """Log runs to MLflow."""
    uri: str | None = None
    """Tracking URI; null: SQLite at <results>/mlflow.db. It must hold no password: libpq reads PGPASSWORD or ~/.pgpass, MLflow's
    client MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD."""
    experiment: Name = "neuspring"
    """Name of the MLflow experiment."""

    def __post_init__(self) -> None:
        if self.uri:
            refuse_password("uri", self.uri, "PGPASSWORD, ~/.pgpass or MLFLOW_TRACKING_PASSWORD")


@dataclass(frozen=True, kw_only=True)
class Aim(SettingsSection):
    """A ratio of errors that is aimed at: it is reached if the mean is at most `ratio` and the interval lies below `below`."""

    method: Name
    """The method whose error is above the line."""
    baseline: Name
    """The method whose error is below the line."""
    task: Literal["reconstruction", "future", "transfer"] = "future"
    """Training frames, future frames, or twins on other recordings."""
    metric: Name = "track_error"
    """The error: a metric of positions, for example chamfer or track_error_bound."""
    ratio: Annotated[float, Field(gt=0.0)]
    """Largest geometric mean."""
    below: Annotated[float, Field(gt=0.0)] = 1.0
    """Bound of the 95 % interval, which must lie below it; 1.05 stands for "not worse by 5 %"."""


@dataclass(frozen=True, kw_only=True)
@with_extensions("")
class Config(SettingsSection):
    """One benchmark: which scenarios, methods and seeds, and how."""

    scenarios: tuple[Name, ...] = ()
    """Scenarios that are run: rows of the scenario table, captures in `data_root` by the names of their folders, and names that
    a source of a package gives to its recordings there."""
    methods: tuple[Name, ...] = ()
    """Rows of the method table that are run, beside the methods in the rows of `studies`. If studies add any, all methods stand in
    the order of the method table."""
    compare_with: Name | None = None
    """The method that tables compare the others with; the first method where this is null or is not run."""
    objects: Literal["scenario", "category"] = "scenario"
    """Objects that intervals of ratios are over: every scenario, or all of a category together (the recordings of one object)."""
    aims: tuple[Aim, ...] = ()
    """Ratios that methods are to reach against others, declared before the run, see [aims](#aims)."""
    seeds: Seeds = (0,)
    """Seeds of the search and of a field's first weights; every method runs with the same seeds. On the command line:
    `--config seeds=0,1,2`."""
    effort: Effort | None = None
    """Sizes that are set together, see [effort](#effort): quick, normal or paper; a key that is given wins over them; null: none is
    set."""
    clusters: Count = 5
    """Number K of regions of the piecewise topology, as in the paper, for the rows of the search table that name none."""
    only: str = ""
    """Part of the scenarios, methods and seeds that is run now, as in
    `--config only="category=rope,cloth method=clusters_* seed=0"`. Terms are scenario, category, method and seed, each with names
    or patterns; empty: all are run."""
    studies: tuple[Name, ...] = ()
    """Rows of the study table (the paper's tables) that are made, with the methods in their rows; each is also a target by its
    name."""
    transfers: dict[Name, tuple[Name, ...]] | None = None
    """Scenario -> other recordings of the same object, on which its twins are rolled out as well; null: none."""
    pools: dict[Name, tuple[Name, ...]] | None = None
    """Name -> scenarios that are recordings of one object, for methods with `pool`; null: none."""
    results: Annotated[
        str, StringConstraints(pattern=r"^[^{}\n]+$"), AfterValidator(lambda path: os.path.normpath(os.path.expanduser(path)))
    ] = "results"
    """Folder for everything that is written; `~` is the home folder."""
    tables: Name = "tables"
    """Folder for tables in the results folder. Use another name to keep the tables of another choice of methods apart."""
    data_root: Annotated[str, AfterValidator(os.path.expanduser)] | None = None
    """Folder from which relative paths of scenarios start."""
    scenario_table: str = "config/scenarios.tsv"
    """The scenario table; its path is relative to the Snakefile."""
    method_table: str = "config/methods.yaml"
    """The method table; its path is relative to the Snakefile."""
    search_table: str = "config/searches.yaml"
    """The search table; its path is relative to the Snakefile."""
    study_table: str = "config/studies.yaml"
    """The study table; its path is relative to the Snakefile."""
    extra_rows: dict[Name, str] = field(default_factory=dict)
    """Name -> file with more rows of these tables, in the sections `methods`, `searches` and `studies`; paths are relative to the
    Snakefile."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the simulations; auto: CUDA where there are GPUs, see [gpus](#gpus)."""
    twins_per_launch: Count | Literal["auto"] = "auto"
    """Most candidates of a search, or fits of a scenario, in one launch; auto: on a CPU as many as save time, on CUDA all. On a CPU
    no result depends on it, bit for bit."""
    gpus: Gpus = field(default_factory=Gpus)
    simulation: SimulationSettings = field(default_factory=SimulationSettings)
    losses: Losses = field(default_factory=Losses)
    search: Search = field(default_factory=Search)
    fit: Fit = field(default_factory=Fit)
    released_quirks: ReleasedQuirks = field(default_factory=ReleasedQuirks)
    toy: Toy = field(default_factory=Toy)
    perception: Perception = field(default_factory=Perception)
    images: Images = field(default_factory=Images)
    baselines: Baselines = field(default_factory=Baselines)
    tracking: Tracking = field(default_factory=Tracking)
    tune: Tune | None = None
    """A sweep over settings, for the target `sweep`, see [tune](#tune); null: none."""

    def expanded(self) -> Config:
        """The configuration with the scenarios, pools and transfers that sections of packages stand for. Raises InputError."""
        whole = self
        for section in vars(self).values():
            whole = section.expand(whole) if isinstance(section, SettingsSection) else whole
        return whole

    @classmethod
    def completed(cls, given: Mapping[str, Any]) -> Mapping[str, Any]:
        """The given values, on top of the sizes of their effort."""
        values = sizes(given["effort"]) if given.get("effort") in EFFORTS else {}
        merge(values, given)
        return values

    def __post_init__(self) -> None:
        for name in ("scenarios", "methods", "seeds", "studies"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise ValueError(f"{name}: entries must differ, received {list(values)}")
        pooled = [name for members in (self.pools or {}).values() for name in members]
        if len(set(pooled)) != len(pooled) or any(len(members) < 2 for members in (self.pools or {}).values()):
            raise ValueError("pools: at least two scenarios each, and every scenario in one pool at most, are required")
        for source, targets in (self.transfers or {}).items():
            if not targets or len({source, *targets}) <= len(targets):
                raise ValueError(f"transfers.{source}: other scenarios, each once, are required, received {list(targets)}")


def select(config: Config, keys: Iterable[str]) -> dict[str, Any]:
    """The values under dotted keys (`images.backend`), nested as in a configuration file, as plain values."""
    values = plain(config)
    part: dict[str, Any] = {}
    for key in keys:
        merge(part, nested(key, functools.reduce(dict.__getitem__, key.split("."), values)))
    return part


def read_settings(text: str) -> Config:
    """Settings from JSON text, or from YAML files separated by commas (later ones override). Raises InputError."""
    if text.lstrip().startswith("{"):
        return parse(Config, json_value("--settings", text), "--settings")
    values: dict[str, object] = {}
    for name in text.split(","):
        merge(values, read_yaml(Path(name)))
    return parse(Config, values, f"--settings {text}")
