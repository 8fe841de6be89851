"""The interface of a body, the kind of model of a twin: the lattice, or a body of another package.

A body is the attribute `body` of a module in `neuspring.twin.bodies`, or an entry point of the group `neuspring.bodies`. A body
imports its numerical libraries inside its methods, because the workflow reads names and settings before any job exists.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neuspring.config import Config
from neuspring.config.simulation import RestLengths
from neuspring.config.twin import TERMS
from neuspring.core.artifacts import Artifact, Observations, Twin
from neuspring.registry import Registry, modules

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, kw_only=True)
class Learned:
    """The result of a search or a fit."""

    twin: Twin
    course: pd.DataFrame
    """Losses by step, for history.parquet."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Numbers and text for the record."""
    attempts: int = 1
    """1, plus one for every time it resumed from its record."""
    earlier_seconds: float = 0.0
    """Wall time of the earlier attempts, up to their last record, s."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """Options of a search. A body ignores options that do not apply to it."""

    clusters: int = 1
    """Number of regions of the topology, each with its own values."""
    seed: int = 0
    device: str = "cpu"
    threads: int = 1
    together: int = 0
    """Maximum number of candidates per launch; 0: as many as are fast on the device."""
    record: Path | None = None
    """File of the trace. The search may resume from an existing trace with the same `key`."""
    key: str = ""


@dataclass(frozen=True)
class SearchTask:
    """A search and its inputs."""

    observations: Observations
    pool: Sequence[Observations]
    settings: Config
    options: SearchOptions


@dataclass(frozen=True)
class FitTask:
    """A fit and the file of its checkpoints."""

    problem: Any
    """A `fit.FitProblem`."""
    partial: Path | None = None
    """File of the checkpoints. The fit resumes from an existing checkpoint with the same `key`."""
    key: str = ""
    threads: int = 1


@dataclass(frozen=True, eq=False, kw_only=True)
class Lines:
    """Lines of a figure of a twin: first those of its body, then the controller springs.

    Points are the nodes, then the controllers, then further points of the body.
    """

    pairs: np.ndarray
    """Ends [L, 2]."""
    rest_lengths: np.ndarray
    """[L], m."""
    stiffness: np.ndarray
    """[L], N."""
    inner: int
    """Number of the body's lines; the remaining lines are controller springs."""
    kind: str
    """Name of the body's lines: springs, edges."""
    about: str
    """Name of the body's lines in figures of stiffness."""
    labels: np.ndarray
    """Region of each point [P]."""
    masses: np.ndarray
    """Mass of each point [P], kg; 0 for a point without mass."""
    points: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """Function from nodes [N, 3] and controllers [C, 3] to all points [P, 3], m."""

    @property
    def kinds(self) -> str:
        """Names of all lines, controller springs included."""
        return " and ".join(dict.fromkeys([self.kind, "springs"]))

    @property
    def typical(self) -> float:
        """Median stiffness of the body's lines, N; of all lines if the body has none."""
        return float(np.median(self.stiffness[: self.inner or None]))


class Body(ABC):
    """A kind of body. The defaults suit implicitly integrated bodies, for which any substep is stable."""

    name: str
    """Name in the registry."""
    fits: tuple[str, ...]
    """Supported kinds of fits; the first is the default."""
    reads: tuple[str, ...] = ()
    """Settings that its search reads in addition to those of every search."""
    by_gradients = False
    """True if fits run epoch by epoch with gradients: they share launches, and sweeps watch them."""
    format: str
    """Name of the plain export's format."""
    about: str
    """Description of the body in the plain export."""
    convention = "1 kg per node"
    """Masses of twins whose object was not weighed."""
    sizes: Mapping[str, str] = {}
    """Meaning of the array dimensions of its data (`Twin.body`), in the plain export."""
    equations: str
    """Steps of its simulation in the plain export, one paragraph per step."""

    @abstractmethod
    def describes(self, twin: Twin) -> bool:
        """Return True if the twin has this body, by `Twin.body`."""

    # --- from recordings to twins

    @abstractmethod
    def search(self, observations: Observations, pool: Sequence[Observations], settings: Config, options: SearchOptions) -> Learned:
        """Search a coarse twin, on a recording and a pool of other recordings."""

    @abstractmethod
    def fit(self, problem: Any, *, partial: Path | None = None, key: str = "", threads: int = 1) -> Learned:
        """Fit the twin of a `fit.FitProblem`; write checkpoints to the file `partial`."""

    def search_many(self, tasks: Sequence[SearchTask]) -> Sequence[Learned | Exception]:
        """Return the result of each search, or the exception that ended it. Searches may share launches."""
        return [_tried(self.search, task.observations, task.pool, task.settings, task.options) for task in tasks]

    def fit_many(self, tasks: Sequence[FitTask], most: int = 0) -> Sequence[Learned | Exception]:
        """Return the result of each fit, or the exception that ended it.

        At most `most` fits share launches; 0: as many as are fast.
        """
        return [_tried(self.fit, task.problem, partial=task.partial, key=task.key, threads=task.threads) for task in tasks]

    @abstractmethod
    def require_pool(self, here: Observations, pool: Sequence[Observations]) -> None:
        """Raise InputError unless one twin can be simulated on all recordings."""

    @abstractmethod
    def on_recording(self, twin: Twin, observations: Observations, rest_lengths: RestLengths) -> Twin:
        """Return the twin in frame 0 of another recording of its object (`simulation.rest_lengths`).

        The simulation settings stay those of the twin. Raises InputError if the recording does not match the twin.
        """

    # --- simulation

    @abstractmethod
    def solver(self, twin: Twin, device: str = "cpu") -> Any:
        """Return a solver without gradients that has the methods of `physics.solver.FrameSolver` that rollouts call."""

    def check(self, twin: Twin) -> None:
        """Raise Unstable if the twin's substep is beyond the stability bound."""
        return

    def stable(self, twin: Twin, safety: float) -> Twin:
        """Return the twin with at least the substeps that the fraction `safety` of the stability bound requires."""
        return twin

    def for_prediction(self, twin: Twin) -> Twin:
        """Return the twin with the substeps of a prediction."""
        return twin

    def load(self, twin: Twin) -> float:
        """Return the stability criterion at the twin's substep; stable below `stability.STABILITY_LIMIT`."""
        return 0.0

    # --- figures and files

    @abstractmethod
    def lines(self, twin: Twin) -> Lines:
        """Return all lines of a twin."""

    @abstractmethod
    def node_stiffness(self, twin: Twin) -> np.ndarray:
        """Return the stiffness of each node in figures [N], N."""

    @abstractmethod
    def mass_at(self, twin: Twin, node: int) -> float:
        """Return the mass that a force on a node accelerates directly, kg."""

    def version(self, twin: Twin) -> int:
        """Return the version of the plain export's format that a twin requires."""
        return 1


def _tried(function: Callable[..., Learned], *arguments: Any, **options: Any) -> Learned | Exception:
    try:
        return function(*arguments, **options)
    except Exception as error:
        return error


BODIES: Registry[Body] = Registry("bodies", modules("neuspring.twin.bodies", "body"), type=Body)


def code(*bodies: str) -> tuple[str, ...]:
    """Modules of the named bodies (none named: all) and of the loss terms of packages, for digests of code."""
    modules = [*map(BODIES.module_of, bodies or BODIES), *map(TERMS.module_of, TERMS)]
    return tuple(dict.fromkeys(name for name in modules if name != "neuspring.twin.losses"))


def body_of(twin: Twin) -> Body:
    """The body of a twin: the last registered body that describes it, so bodies of packages have priority."""
    return next(body for body in reversed(list(BODIES.values())) if body.describes(twin))


def lines_of(twin: Twin) -> Lines:
    """All lines of a twin."""
    return body_of(twin).lines(twin)


def with_mass(twin: Twin, total: float) -> Twin:
    """Scale a twin to the total mass, kg, without a change of its motion: multiply all values in N or kg by one factor.

    Drag is per mass, and collisions depend only on ratios of masses.
    """
    masses = lines_of(twin).masses
    of_nodes = masses[: len(twin.topology.nodes)]
    if of_nodes.all():
        twin = replace(twin, material=replace(twin.material, mass=of_nodes))
    scaled: Twin = _scaled(twin, total / float(masses.sum(dtype=np.float64)))
    return scaled


def _scaled(part: Any, factor: float) -> Any:
    changed = {}
    for spec in fields(part):
        value = getattr(part, spec.name)
        if isinstance(value, Artifact):
            changed[spec.name] = _scaled(value, factor)
        elif spec.metadata.get("unit", "").partition(" ")[0] in ("N", "kg"):
            changed[spec.name] = value * factor
    return replace(part, **changed)
