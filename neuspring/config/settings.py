"""The whole configuration as frozen dataclasses: what may be set, its unit, its range, its default.

`parse` turns plain YAML values into these dataclasses strictly: unknown keys raise, values are never cast (YAML reads `5e-5` as
text; we say so instead of guessing), and every problem is listed with its path. This module imports nothing heavy, because
the workflow reads it before any job exists.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import AfterValidator, Field, StringConstraints, TypeAdapter, ValidationError

from neuspring.config.baselines import Baselines
from neuspring.config.gpus import Gpus
from neuspring.config.images import Images
from neuspring.config.perception import Perception, Synthetic
from neuspring.config.tuning import Tune
from neuspring.config.types import STRICT, Count, Finite, Name, NonNegative, Positive, Range
from neuspring.core.errors import InputError
from neuspring.core.uri import masked, refuse_password

T = TypeVar("T")
Beta = Annotated[float, Field(ge=0, lt=1)]
Kind = Literal["springs", "field"]
"""What a first-order stage trains: each spring by itself, or the neural spring field."""


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Integration. See `neuspring.core.artifacts.Simulation`; up, ground and self-collision come with the scenario."""

    __pydantic_config__ = STRICT
    substeps: Count | Literal["auto"] = "auto"
    """Integration steps per frame; `auto` takes the smallest count that the stability bound allows."""
    safety: Annotated[float, Field(gt=0, le=0.95)] = 0.8
    """Fraction of the stability bound that `auto` uses."""
    max_substeps: Count = 2000
    """`auto` never asks for more; a candidate that would need more is penalised by the search."""
    gravity: Finite = 9.8
    """m/s^2, downwards."""
    collision_capacity: Count = 500
    """Candidate partners per node and frame; overflow is reported."""
    controller_velocity: bool = False
    """Controllers have their finite-difference velocity in the dashpots; the released simulator uses zero."""
    initial_velocity: Literal["rest", "observed"] = "rest"
    """Velocity in frame 0: zero, as released, or what the first three frames show (for captures that begin in motion)."""


@dataclass(frozen=True, kw_only=True)
class Losses:
    """Weights of the training losses; the defaults are those of the released PhysTwin code."""

    __pydantic_config__ = STRICT
    chamfer: NonNegative = 1.0
    """Squared single-directional Chamfer distance."""
    track: NonNegative = 1.0
    """Smooth-L1 error of tracked points."""
    acceleration: NonNegative = 0.01
    """Used by the search only, as in the released method."""


@dataclass(frozen=True, kw_only=True)
class SearchRanges:
    """Bounds of the zero-order search; units as in `neuspring.core.artifacts.Material`, lengths in metres."""

    __pydantic_config__ = STRICT
    stiffness: Range = (0.0, 1e5)
    """Y, N."""
    object_radius: Range = (0.01, 0.05)
    """Search radius between object nodes, m."""
    object_neighbours: Range = (10, 50)
    """Most neighbours of an object node, itself included."""
    controller_radius: Range = (0.01, 0.08)
    """Search radius of controllers, m."""
    controller_neighbours: Range = (10, 80)
    """Most nodes held by a controller."""
    ground_elasticity: Range = (0.0, 1.0)
    """Restitution on the ground."""
    ground_friction: Range = (0.0, 2.0)
    """Friction on the ground."""
    contact_elasticity: Range = (0.0, 1.0)
    """Restitution between nodes."""
    contact_friction: Range = (0.0, 2.0)
    """Friction between nodes."""
    contact_distance: Range = (0.01, 0.05)
    """Distance at which nodes collide, m."""
    drag: Range = (0.0, 20.0)
    """Velocity decay, 1/s."""
    dashpot: Range = (0.0, 200.0)
    """Damping along springs, N s/m."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            low, high = getattr(self, f.name)
            if not 0 <= low < high:
                raise ValueError(f"{f.name}: 0 <= low < high is required, received [{low}, {high}]")
        for name in ("object_neighbours", "controller_neighbours"):
            # An object node counts itself among its neighbours.
            least = 2 if name == "object_neighbours" else 1
            if getattr(self, name)[0] < least:
                raise ValueError(f"{name}: at least {least} is required, received {getattr(self, name)[0]}")
        if self.contact_distance[0] <= 0:
            raise ValueError(f"contact_distance: must be positive, received {self.contact_distance[0]}")


@dataclass(frozen=True, kw_only=True)
class SearchStart:
    """Where the search starts; the released configuration's defaults."""

    __pydantic_config__ = STRICT
    stiffness: float = 3e4
    """Y, N."""
    object_radius: float = 0.02
    """Search radius between object nodes, m."""
    object_neighbours: float = 30
    """Most neighbours of an object node, itself included."""
    controller_radius: float = 0.04
    """Search radius of controllers, m."""
    controller_neighbours: float = 50
    """Most nodes held by a controller."""
    ground_elasticity: float = 0.5
    """Restitution on the ground."""
    ground_friction: float = 0.3
    """Friction on the ground."""
    contact_elasticity: float = 0.7
    """Restitution between nodes."""
    contact_friction: float = 0.3
    """Friction between nodes."""
    contact_distance: float = 0.02
    """Distance at which nodes collide, m."""
    drag: float = 3.0
    """Velocity decay, 1/s."""
    dashpot: float = 100.0
    """Damping along springs, N s/m."""


@dataclass(frozen=True, kw_only=True)
class Clusters:
    """Regions of a piecewise topology: agglomerative clustering of the nodes in the rest shape; a search row says how many."""

    __pydantic_config__ = STRICT
    linkage: Literal["ward", "complete", "average", "single"] = "ward"
    """Which distance between regions is kept small; ward: the growth of their variance."""
    connectivity: Annotated[int, Field(ge=0)] = 0
    """Only regions joined by a graph of each node's nearest neighbours may merge: how many; 0 lets any two merge."""


@dataclass(frozen=True, kw_only=True)
class Search:
    """Zero-order stage: CMA-ES over homogeneous material and topology."""

    __pydantic_config__ = STRICT
    rollouts: Count = 220
    """Budget in candidate rollouts; every method compared gets the same. The last generation may be cut short."""
    sigma: Positive = 1 / 6
    """Initial step in normalised variables."""
    tied_rollouts: Annotated[int, Field(ge=0)] = 0
    """Rollouts, of the budget, in which all regions share their values; then each region is freed around the best candidate."""
    freed_sigma: Positive = 0.06
    """Step in normalised variables when the regions are freed."""
    stiffness_scale: Literal["linear", "log"] = "linear"
    """Scale on which stiffness is normalised; log needs a positive lower bound."""
    isolated_nodes: Literal["repair", "penalise", "allow"] = "repair"
    """Nodes without any spring: joined to their 3 nearest nodes, cause for refusing the candidate, or left (as released)."""
    clusters: Clusters = field(default_factory=Clusters)
    """Regions of a piecewise topology, see [search.clusters](#searchclusters)."""
    ranges: SearchRanges = field(default_factory=SearchRanges)
    """Bounds, see [search.ranges](#searchranges)."""
    start: SearchStart = field(default_factory=SearchStart)
    """Start, see [search.start](#searchstart)."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self.start):
            low, high = getattr(self.ranges, f.name)
            value = getattr(self.start, f.name)
            if not low <= value <= high:
                raise ValueError(f"start.{f.name} = {value} lies outside ranges.{f.name} = [{low}, {high}]")
        if self.stiffness_scale == "log" and self.ranges.stiffness[0] <= 0:
            rule = "stiffness_scale: log needs a positive lower bound of ranges.stiffness"
            raise ValueError(f"{rule}, received {list(self.ranges.stiffness)}")
        if self.tied_rollouts >= self.rollouts:
            raise ValueError(f"tied_rollouts must be below rollouts ({self.rollouts}), received {self.tied_rollouts}")


@dataclass(frozen=True, kw_only=True)
class SpringField:
    """Neural spring field: S(e) = S0 + F(x_mid(e)), F a tri-plane and a small MLP over spring midpoints in the rest shape."""

    __pydantic_config__ = STRICT
    triplane: bool = True
    """Three feature planes (xy, yz, xz), bilinear, summed. Without them F is an MLP on Fourier features of the coordinates."""
    resolution: Annotated[int, Field(ge=2)] | Literal["adaptive"] = "adaptive"
    """Texels N per side of a plane; adaptive: round(adaptive_factor sqrt(springs)), at least 2."""
    adaptive_factor: Positive = 0.85
    """Of an adaptive resolution."""
    channels: Count = 32
    """Features per texel, C."""
    plane_scale: NonNegative = 0.1
    """Standard deviation of the texels at the start."""
    hidden: Count = 128
    """Units per hidden layer of the MLP, which has three layers."""
    fourier: Literal["feature", "coordinates", "both", "none"] = "both"
    """What the Fourier transform is applied to: the summed plane feature, the coordinates (concatenated), or both."""
    bands: Count = 4
    """Frequencies 1, 2, 4, ... (times pi) of the Fourier transform."""
    scale: Literal["log", "linear"] = "log"
    """log: Y = Y0 exp(F). linear: Y = Y0 (1 + F)."""
    controllers: bool = True
    """Whether controller springs are covered too; otherwise they keep S0."""
    plane_learning_rate: Positive | None = None
    """Of the texels; null: as the MLP."""
    plane_smoothness: NonNegative = 0.0
    """Weight of the mean squared difference of neighbouring texels, m^2."""
    weight_decay: NonNegative = 0.0
    """Decoupled weight decay of texels and MLP."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """First-order stage: Adam, gradients through the simulation. What is free per spring is a method's `fit`."""

    __pydantic_config__ = STRICT
    epochs: Count = 200
    """Passes over the training frames."""
    learning_rate: Positive = 1e-3
    """Of Adam, on log stiffness per spring or the field's weights."""
    scalar_learning_rate: Positive | None = None
    """Of contact scalars, drag and homogeneous factors; null: as `learning_rate`."""
    rest_learning_rate: Positive | None = None
    """Of rest lengths that are free beside a field; null: as `learning_rate`."""
    betas: tuple[Beta, Beta] = (0.9, 0.99)
    """Of Adam."""
    schedule: Literal["constant", "cosine"] = "constant"
    """How the learning rates change over the epochs; cosine: down to a hundredth."""
    warmup_epochs: Annotated[int, Field(ge=0)] = 0
    """Epochs over which learning rates rise linearly."""
    homogeneous_epochs: Annotated[int, Field(ge=0)] = 0
    """Warm start: in these first epochs one common factor and the scalars are trained, not the single springs."""
    horizon: Annotated[int, Field(ge=0)] = 1
    """Frames per optimiser step, with the gradient through all of them; 0 means all training frames."""
    clip_gradient_norm: NonNegative = 0.0
    """0 disables clipping."""
    output_bound: NonNegative = 0.0
    """Springs stay within exp(+-bound) of the searched stiffness (and dashpot), by bound tanh(./bound), beside what common factors
    change; 0: unbounded."""
    stiffness_range: Range = (0.0, 1e5)
    """Clamp of the stiffness inside the simulation."""
    damping: Literal["fixed", "homogeneous", "springs"] = "fixed"
    """Train drag and one factor of all dashpots, or a dashpot per spring (by the field, where the method has one)."""
    rest_length_bound: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Train rest lengths within exp(+-bound) of the distances in the rest shape; 0: fixed."""
    rest_lengths_by: Literal["springs", "field"] = "springs"
    """Whether trained rest lengths are free per spring, or an output of the field (for methods that have one)."""
    selection: Literal["training_loss", "tail"] = "training_loss"
    """Best epoch by the loss seen while training (paper), or by a held-back tail of the training frames, the start included."""
    tail_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """Fraction of the training frames that `selection: tail` holds back from training."""
    field: SpringField = dataclasses.field(default_factory=SpringField)
    """See [fit.field](#fitfield)."""
    checkpoint_every: Count = 5
    """Epochs between checkpoints from which a killed job continues."""

    def __post_init__(self) -> None:
        low, high = self.stiffness_range
        if not 0 <= low < high:
            raise ValueError(f"stiffness_range: 0 <= low < high is required, received [{low}, {high}]")
        if not self.field.triplane and self.field.fourier not in ("coordinates", "both"):
            raise ValueError(f"field.fourier: coordinates is required without the tri-plane, received {self.field.fourier}")


@dataclass(frozen=True, kw_only=True)
class ReleasedQuirks:
    """Behaviours of the released PhysTwin code that differ from its description; all off by default.

    See the README, "Released quirks".
    """

    __pydantic_config__ = STRICT
    integer_damping: bool = False
    """Truncate drag and dashpot to integers after the search."""
    frozen_loss_denominators: bool = False
    """Divide every frame's losses by the valid counts of frame 1."""
    frame_time_667: bool = False
    """A frame lasts 667 x 5e-5 s = 33.35 ms, whatever the frame rate, in 667 substeps."""
    sparse_checkpoints: bool = False
    """Consider the best epoch only every 20 epochs and at the last."""


@dataclass(frozen=True, kw_only=True)
class Toy:
    """Analytic scenes simulated by the float64 reference, with known stiffness."""

    __pydantic_config__ = STRICT
    frames: Annotated[int, Field(ge=5)] = 60
    """Frames per scene; the first 70 % are for training."""
    frame_rate: Positive = 30.0
    """Frames per second."""
    noise: NonNegative = 0.0005
    """Standard deviation of the observation noise, m."""
    occlusion: Annotated[float, Field(ge=0, lt=1)] = 0.2
    """Fraction of point-frames hidden, in runs of several frames."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Of noise and occlusion; the scenario's name enters too."""


@dataclass(frozen=True, kw_only=True)
class Mocap:
    """Motion capture of cables: end markers control, inner markers are observed, the body is sampled as rings."""

    __pydantic_config__ = STRICT
    stride: Count = 2
    """Use every n-th sample of the 100 Hz record."""
    start: Annotated[int, Field(ge=0)] = 0
    """Samples of the record left out at its beginning."""
    frames: Annotated[int, Field(ge=5)] | None = None
    """Keep only the first frames (after the stride); null keeps all."""
    spacing: Positive = 0.012
    """Distance of rings along the centreline, m."""
    rings: Annotated[int, Field(ge=2)] | None = None
    """Number of rings, whatever their spacing: a twin can then move to another recording of the cable; null: by `spacing`."""
    radius: Positive = 0.006
    """Ring radius, m."""
    ring: Annotated[int, Field(ge=3)] = 4
    """Nodes per ring."""
    rest_shape: Literal["first_frame", "straight"] = "first_frame"
    """Shape without forces: that of frame 0, as in the paper, or a straight cable with the arc lengths of frame 0."""
    train_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.7
    """Frames before this fraction are for training."""


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """MLflow. Files are the record; this is their index."""

    __pydantic_config__ = STRICT
    enabled: bool = True
    """Log runs to MLflow."""
    uri: str | None = None
    """Tracking URI; null means SQLite at <results>/mlflow.db. No password in it: libpq reads PGPASSWORD or ~/.pgpass, MLflow's
    client MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD."""
    experiment: Name = "neuspring"
    """Name of the MLflow experiment."""

    def __post_init__(self) -> None:
        if self.uri:
            refuse_password("uri", self.uri, "PGPASSWORD, ~/.pgpass or MLFLOW_TRACKING_PASSWORD")


@dataclass(frozen=True, kw_only=True)
class Config:
    """One benchmark: which scenarios, methods and seeds, and how."""

    __pydantic_config__ = STRICT
    scenarios: tuple[Name, ...] = ()
    """Rows of the scenario table."""
    methods: tuple[Name, ...] = ()
    """Rows of the method table."""
    compare_with: Name | None = None
    """The method that tables compare the others with; the first where it is null or not among `methods`."""
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = (0,)
    """Of the search and of a field's first weights; every method runs with the same ones."""
    only: str = ""
    """Part of these scenarios, methods and seeds: terms scenario, category, method and seed, each with names or patterns, as in
    `--config only="category=rope,cloth method=clusters_* seed=0"`; empty: all."""
    studies: tuple[Name, ...] = ()
    """Rows of the study table, the paper's tables, that `all` makes; each is also a target by its name."""
    transfers: dict[Name, tuple[Name, ...]] | None = None
    """Scenario -> other recordings of the same object, on which its twins are rolled out as well, if it is chosen; null: none."""
    results: Annotated[str, StringConstraints(pattern=r"^[^{}\n]+$"), AfterValidator(os.path.normpath)] = "results"
    """Folder that everything is written to."""
    tables: Name = "tables"
    """Folder for tables in the results folder; another name keeps the tables of another choice of methods apart."""
    data_root: str | None = None
    """Folder that relative scenario paths start from."""
    scenario_table: str = "config/scenarios.tsv"
    """Relative to the Snakefile."""
    method_table: str = "config/methods.yaml"
    """Relative to the Snakefile."""
    search_table: str = "config/searches.yaml"
    """Relative to the Snakefile."""
    study_table: str = "config/studies.yaml"
    """Relative to the Snakefile."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: CUDA where there are GPUs. Which ones: [gpus](#gpus)."""
    gpus: Gpus = field(default_factory=Gpus)
    """See [gpus](#gpus)."""
    simulation: Simulation = field(default_factory=Simulation)
    """See [simulation](#simulation)."""
    losses: Losses = field(default_factory=Losses)
    """See [losses](#losses)."""
    search: Search = field(default_factory=Search)
    """See [search](#search)."""
    fit: Fit = field(default_factory=Fit)
    """See [fit](#fit)."""
    released_quirks: ReleasedQuirks = field(default_factory=ReleasedQuirks)
    """See [released_quirks](#released_quirks)."""
    toy: Toy = field(default_factory=Toy)
    """See [toy](#toy)."""
    mocap: Mocap = field(default_factory=Mocap)
    """See [mocap](#mocap)."""
    synthetic: Synthetic = field(default_factory=Synthetic)
    """See [synthetic](#synthetic)."""
    perception: Perception = field(default_factory=Perception)
    """See [perception](#perception)."""
    images: Images = field(default_factory=Images)
    """See [images](#images)."""
    baselines: Baselines = field(default_factory=Baselines)
    """See [baselines](#baselines)."""
    tracking: Tracking = field(default_factory=Tracking)
    """See [tracking](#tracking)."""
    tune: Tune | None = None
    """A tuning study, for the target `sweep`, see [tune](#tune); null: none."""

    def __post_init__(self) -> None:
        for name in ("scenarios", "methods", "seeds", "studies"):
            values = getattr(self, name)
            if len(set(values)) != len(values):
                raise ValueError(f"{name}: entries must differ, received {list(values)}")
        for source, targets in (self.transfers or {}).items():
            if not targets or len(set(targets)) != len(targets) or source in targets:
                rule = "at least one other scenario is required, each once; leave the entry out for no transfer"
                raise ValueError(f"transfers.{source}: {rule}, received {list(targets)}")


@dataclass(frozen=True, kw_only=True)
class SearchRow:
    """A row of the search table: into how many regions the topology is divided, and settings of its own."""

    __pydantic_config__ = STRICT
    clusters: Count
    """Regions K with their own radius and neighbours: 2K + 10 variables. 1 is the uniform topology."""
    description: str
    settings: dict[str, Any] = field(default_factory=dict)
    """Search settings of this row alone (keys of `search`), on top of the configuration's."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """A row of the method table: a twin (which search it starts from, what follows) or a baseline's model; how it predicts."""

    __pydantic_config__ = STRICT
    description: str
    search: Name | None = None
    """A row of the search table; methods that name the same row share the search."""
    fit: Kind | None = None
    """What the first-order stage trains: each spring by itself, or the neural spring field."""
    model: Name | None = None
    """A baseline without search and fit (`neuspring.baselines.BASELINES`)."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of this method alone, on top of the configuration's: keys of `fit` (for example `horizon: 0`), or of its model's
    section of `baselines`."""
    appearance: dict[str, Any] | None = None
    """Splats of this method's own: keys of `images.appearance`, on top of the configuration's; null: those of all methods."""
    carry_over: bool = False
    """Correct the state at the last training frame by what was observed there, where training frames say that it helps."""
    average_seeds: bool = False
    """Predict the mean of the trajectories of all seeds; costs as many fits as there are seeds."""

    def __post_init__(self) -> None:
        if (self.search is None) == (self.model is None):
            raise ValueError(f"either search or model is required, received search {self.search} and model {self.model}")
        twins_only = {"fit": self.fit, "carry_over": self.carry_over, "average_seeds": self.average_seeds}
        given = [name for name, value in twins_only.items() if value]
        if self.model and given:
            raise ValueError(f"{', '.join(given)}: these belong to methods with a search, not to model {self.model}")


@dataclass(frozen=True, kw_only=True)
class ScenarioRow:
    """A row of the scenario table."""

    __pydantic_config__ = STRICT
    scenario: Name
    source: Name
    """The kind of its data (`neuspring.data.sources.SOURCES`)."""
    category: Name
    path: str
    """Folder or file under data_root; for toy and synthetic scenes, the scene's name."""
    self_collision: bool
    ground: bool


def parse(kind: type[T], values: Mapping[str, Any], where: str) -> T:
    """Build the dataclass `kind` from plain values, strictly. Raises InputError listing every problem with its path."""
    try:
        result: T = _adapter(kind).validate_json(json.dumps(values), strict=True)  # type: ignore[arg-type]
        return result
    except TypeError as error:
        raise InputError(where, "values must be plain YAML", str(error)) from error
    except ValidationError as error:
        problems = [_describe(problem) for problem in error.errors()]
        raise InputError(where, "\n  " + "\n  ".join(problems), remedy="\nSee config/README.md for every key.") from error


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    """Building one takes longer than a thousand uses of it."""
    return TypeAdapter(kind)


def _describe(problem: Any) -> str:
    path = ".".join(str(part) for part in problem["loc"] if not str(part).startswith("constrained")) or "(top level)"
    value = problem["input"]
    if problem["type"] == "unexpected_keyword_argument":
        return f"{path}: unknown key"
    if problem["type"] == "missing":
        return f"{path}: required, but missing"
    hint = ""
    if isinstance(value, str) and problem["type"] in ("float_type", "int_type"):
        hint = " (YAML reads a number such as 5e-5 as text: write 5.0e-5)"
    message = problem["msg"].removeprefix("Value error, ")
    return f"{path}: {message[:1].lower()}{message[1:]}, received {masked(repr(value))}{hint}"


def plain(settings: Any) -> dict[str, Any]:
    """The settings as plain YAML/JSON values (lists, not tuples)."""
    result: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(settings)))
    return result


def read_text(path: Path) -> str:
    """A file's text. Raises InputError."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "this file must be readable UTF-8 text", error) from error


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML mapping from a file. Raises InputError."""
    try:
        values = yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise InputError(path, "this file must be YAML", str(error).replace("\n", " ")) from error
    if not isinstance(values, dict):
        raise InputError(path, "this file must hold a YAML mapping", type(values).__name__)
    return values


def merge(base: dict[str, Any], overlay: Mapping[str, Any]) -> None:
    """Put `overlay` on top of `base`, in place: mappings merge, everything else replaces."""
    for key, value in overlay.items():
        below = base.get(key)
        if isinstance(value, Mapping) and isinstance(below, dict):
            merge(below, value)
        else:
            base[key] = value
