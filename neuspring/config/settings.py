"""The complete configuration of a benchmark, with a section for each part of the program. It imports nothing heavy."""

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
    """GPUs of this machine that jobs lease. On a cluster, the scheduler assigns GPUs and only `batch` applies."""

    devices: Literal["all"] | tuple[Device, ...] = "all"
    """Indices or UUIDs of GPUs; all: those of CUDA_VISIBLE_DEVICES, or all of the machine if it is not set."""
    jobs_per_gpu: Count = 1
    """Number of jobs that share a GPU; use 1 for comparable timings."""
    batch: Count | Literal["auto"] = "auto"
    """Maximum number of searches or fits in one job, with shared launches; auto: on GPUs, as many as give every GPU a job, up to
    16; on a CPU, 1. A batch may contain several scenarios and seeds. With 1, only the fits of one scenario share jobs
    (`twins_per_launch`)."""

    def __post_init__(self) -> None:
        if self.devices != "all" and (not self.devices or len(set(map(str, self.devices))) != len(self.devices)):
            raise ValueError(f"devices: at least one device, without repetition, is required, received {list(self.devices)}")


def _seed_list(value: Any) -> Any:
    """Snakemake passes `--config seeds=0,1,2` as text, `seeds=0` as a number, and `seeds=[0,1,2]` as a list of texts."""
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
    """MLflow, an index of the run records."""

    enabled: bool = True
    """Log runs to MLflow."""
    uri: str | None = None
    """Tracking URI; null: SQLite at <results>/mlflow.db. The URI must not contain a password: libpq reads PGPASSWORD or
    ~/.pgpass, MLflow's client reads MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD."""
    experiment: Name = "neuspring"
    """Name of the MLflow experiment."""

    def __post_init__(self) -> None:
        if self.uri:
            refuse_password("uri", self.uri, "PGPASSWORD, ~/.pgpass or MLFLOW_TRACKING_PASSWORD")


@dataclass(frozen=True, kw_only=True)
class Aim(SettingsSection):
    """A target for a ratio of errors: it is met if the mean is at most `ratio` and the interval is below `below`."""

    method: Name
    """Method whose error is the numerator."""
    baseline: Name
    """Method whose error is the denominator."""
    task: Literal["reconstruction", "future", "transfer"] = "future"
    """Training frames, future frames, or other recordings."""
    metric: Name = "track_error"
    """Metric of positions, for example chamfer or track_error_bound."""
    ratio: Annotated[float, Field(gt=0.0)]
    """Maximum of the geometric mean."""
    below: Annotated[float, Field(gt=0.0)] = 1.0
    """Upper limit of the 95 % interval; 1.05 means "at most 5 % worse"."""


@dataclass(frozen=True, kw_only=True)
@with_extensions("")
class Config(SettingsSection):
    """A benchmark: scenarios, methods and seeds, and where results go."""

    scenarios: tuple[Name, ...] = ()
    """Scenarios to run: rows of the scenario table, folders of captures in `data_root`, or recordings of a package's source."""
    methods: tuple[Name, ...] = ()
    """Methods to run, in addition to those of `studies`. If studies add methods, all have the order of the method table."""
    compare_with: Name | None = None
    """Method with which tables compare the others; null, or a method that is not run: the first method."""
    objects: Literal["scenario", "category"] = "scenario"
    """Unit of the intervals of ratios: each scenario, or all scenarios of a category, which then are recordings of one object."""
    aims: tuple[Aim, ...] = ()
    """Target ratios, declared before the run, see [aims](#aims)."""
    seeds: Seeds = (0,)
    """Seeds of the search and of a field's initial weights, the same for all methods. On the command line:
    `--config seeds=0,1,2`."""
    effort: Effort | None = None
    """Named set of sizes, see [effort](#effort); explicit keys override it; null: none."""
    clusters: Count = 5
    """Number K of regions, as in the paper, for searches that do not set it."""
    only: str = ""
    """Subset to run now, as in `--config only="category=rope,cloth method=clusters_* seed=0"`; empty: everything. Terms are
    scenario, category, method and seed, each with names or patterns."""
    studies: tuple[Name, ...] = ()
    """Studies to make, with their methods; each name is also a target."""
    transfers: dict[Name, tuple[Name, ...]] | None = None
    """Scenario -> other recordings of the same object, which its twins also predict; null: none."""
    pools: dict[Name, tuple[Name, ...]] | None = None
    """Name -> scenarios that are recordings of one object, for methods with `pool`; null: none."""
    results: Annotated[
        str, StringConstraints(pattern=r"^[^{}\n]+$"), AfterValidator(lambda path: os.path.normpath(os.path.expanduser(path)))
    ] = "results"
    """Output folder; `~` is the home folder."""
    tables: Name = "tables"
    """Folder of the tables inside the results folder. Use another name to keep tables of different sets of methods."""
    data_root: Annotated[str, AfterValidator(os.path.expanduser)] | None = None
    """Folder to which paths of scenarios are relative."""
    scenario_table: str = "config/scenarios.tsv"
    """Scenario table, relative to the Snakefile."""
    method_table: str = "config/methods.yaml"
    """Method table, relative to the Snakefile."""
    search_table: str = "config/searches.yaml"
    """Search table, relative to the Snakefile."""
    study_table: str = "config/studies.yaml"
    """Study table, relative to the Snakefile."""
    extra_rows: dict[Name, str] = field(default_factory=dict)
    """Name -> file with more `methods`, `searches` and `studies`, relative to the Snakefile."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the simulations; auto: CUDA if there are GPUs, see [gpus](#gpus)."""
    twins_per_launch: Count | Literal["auto"] = "auto"
    """Maximum number of candidates of a search, or fits of a scenario, in one launch; auto: the fastest number on a CPU, all on
    CUDA. On a CPU, results do not depend on it, bit for bit."""
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
    """Sweep over settings, for the target `sweep`, see [tune](#tune); null: none."""

    def expanded(self) -> Config:
        """The configuration with the scenarios, pools and transfers that sections of packages imply. Raises InputError."""
        config = self
        for section in vars(self).values():
            config = section.expand(config) if isinstance(section, SettingsSection) else config
        return config

    @classmethod
    def completed(cls, given: Mapping[str, Any]) -> Mapping[str, Any]:
        """The sizes of the given effort, overridden by the given values."""
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
            raise ValueError("pools: each pool must have at least two scenarios, and no scenario may be in two pools")
        for source, targets in (self.transfers or {}).items():
            if not targets or len({source, *targets}) <= len(targets):
                raise ValueError(f"transfers.{source}: must be different other scenarios, received {list(targets)}")


def select(config: Config, keys: Iterable[str]) -> dict[str, Any]:
    """The values under dotted keys (`images.backend`), nested as in a configuration file, as plain values."""
    values = plain(config)
    part: dict[str, Any] = {}
    for key in keys:
        merge(part, nested(key, functools.reduce(dict.__getitem__, key.split("."), values)))
    return part


def read_settings(text: str) -> Config:
    """Read settings from JSON text, or from YAML files separated by commas (later files override). Raises InputError."""
    if text.lstrip().startswith("{"):
        return parse(Config, json_value("--settings", text), "--settings")
    values: dict[str, object] = {}
    for name in text.split(","):
        merge(values, read_yaml(Path(name)))
    return parse(Config, values, f"--settings {text}")
