"""The body: what a twin is made of. The lattice of springs and the bodies of packages answer the same questions.

A body is a module of `neuspring.twin.bodies` with a `body`, or an entry point of the group `neuspring.bodies`. It imports what it
computes with in its methods: the workflow asks for names and settings before any job exists.
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
    """A twin that a search or a fit has found, and how."""

    twin: Twin
    course: pd.DataFrame
    """Losses by step, for history.parquet."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Numbers and text for the record."""
    attempts: int = 1
    """1, plus one for every time it continued from its record."""
    earlier_seconds: float = 0.0
    """Wall time of the attempts that this one continued, up to what was recorded last."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """The way a search runs; a body leaves alone what it has no use for."""

    clusters: int = 1
    """Regions of a topology, each with values of its own."""
    seed: int = 0
    device: str = "cpu"
    threads: int = 1
    together: int = 0
    """Candidates in one launch at most; 0: as many as are fast on the device."""
    record: Path | None = None
    """File of the trace; one with the same `key` that is there already may be continued."""
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
    """A fit and where its checkpoints go."""

    problem: Any
    """A `fit.FitProblem`."""
    partial: Path | None = None
    """File of the checkpoints; one with the same `key` that is there already is continued."""
    key: str = ""
    threads: int = 1


@dataclass(frozen=True, eq=False, kw_only=True)
class Lines:
    """Lines that a twin is drawn with: those of its body, then the springs of hands.

    A point is a node, then a controller, then what else the body has.
    """

    pairs: np.ndarray
    """Ends [L, 2]."""
    rest_lengths: np.ndarray
    """[L], m."""
    stiffness: np.ndarray
    """[L], N."""
    inner: int
    """Number of lines that are the body's; the others are those of hands."""
    kind: str
    """Name of the body's lines: springs, edges."""
    about: str
    """Their name where stiffness is shown."""
    labels: np.ndarray
    """Region of each point [P]."""
    masses: np.ndarray
    """Mass of each point [P], kg; 0 where it has none."""
    points: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """From nodes [N, 3] and controllers [C, 3] to all points [P, 3], m."""

    @property
    def kinds(self) -> str:
        """Names of all lines, those of hands included."""
        return " and ".join(dict.fromkeys([self.kind, "springs"]))

    @property
    def typical(self) -> float:
        """Median stiffness of the body's lines, N; of all where it has none."""
        return float(np.median(self.stiffness[: self.inner or None]))


class Body(ABC):
    """A kind of body. What has a default holds for bodies that are integrated implicitly: any substep is stable."""

    name: str
    """Its name in the registry."""
    fits: tuple[str, ...]
    """Kinds of fits that it has; the first is the default."""
    reads: tuple[str, ...] = ()
    """Settings that its search reads beside those of every search."""
    by_gradients = False
    """Fits go epoch by epoch, with gradients: they share launches, and sweeps watch them."""
    format: str
    """Name of the plain export's format."""
    about: str
    """The body, in the plain export."""
    convention = "1 kg per node"
    """Masses of its twins where nobody weighed the object."""
    sizes: Mapping[str, str] = {}
    """Meaning of the dimensions of the arrays of its data (`Twin.body`), in the plain export."""
    equations: str
    """A step of its simulation, in the plain export; a paragraph each."""

    @abstractmethod
    def describes(self, twin: Twin) -> bool:
        """True for a twin that has this body, by `Twin.body`."""

    # --- from recordings to twins

    @abstractmethod
    def search(self, observations: Observations, pool: Sequence[Observations], settings: Config, options: SearchOptions) -> Learned:
        """A coarse twin, on a recording and a pool of others."""

    @abstractmethod
    def fit(self, problem: Any, *, partial: Path | None = None, key: str = "", threads: int = 1) -> Learned:
        """The fitted twin of a `fit.FitProblem`; checkpoints go to the file `partial`."""

    def search_many(self, tasks: Sequence[SearchTask]) -> Sequence[Learned | Exception]:
        """The result of each search, or the exception that ended it; searches may share launches."""
        return [_tried(self.search, one.observations, one.pool, one.settings, one.options) for one in tasks]

    def fit_many(self, tasks: Sequence[FitTask], most: int = 0) -> Sequence[Learned | Exception]:
        """The result of each fit, or the exception that ended it; at most `most` (0: as many as are fast) share launches."""
        return [_tried(self.fit, one.problem, partial=one.partial, key=one.key, threads=one.threads) for one in tasks]

    @abstractmethod
    def require_pool(self, here: Observations, pool: Sequence[Observations]) -> None:
        """Raise InputError unless one twin can be judged on all recordings."""

    @abstractmethod
    def on_recording(self, twin: Twin, observations: Observations, rest_lengths: RestLengths) -> Twin:
        """The twin in frame 0 of another recording of its object (`simulation.rest_lengths`).

        Its simulation is still the twin's. Raises InputError if the recording is of another body.
        """

    # --- simulation

    @abstractmethod
    def solver(self, twin: Twin, device: str = "cpu") -> Any:
        """A solver with the calls of `physics.solver.FrameSolver` that rollouts make, without gradients."""

    def check(self, twin: Twin) -> None:
        """Raise Unstable if the twin's substep is beyond the stability bound."""
        return

    def stable(self, twin: Twin, safety: float) -> Twin:
        """The twin with at least as many substeps as a part `safety` of the stability bound asks for."""
        return twin

    def for_prediction(self, twin: Twin) -> Twin:
        """The twin as predictions are made with it."""
        return twin

    def load(self, twin: Twin) -> float:
        """Stability criterion at the twin's substep, below `stability.LIMIT`."""
        return 0.0

    # --- pictures and files

    @abstractmethod
    def lines(self, twin: Twin) -> Lines:
        """All lines of a twin."""

    @abstractmethod
    def node_stiffness(self, twin: Twin) -> np.ndarray:
        """Stiffness that each node shows [N], N."""

    @abstractmethod
    def mass_at(self, twin: Twin, node: int) -> float:
        """Mass that a force on a node moves first, kg."""

    def version(self, twin: Twin) -> int:
        """Version of the plain export's format that can say all of a twin."""
        return 1


def _tried(function: Callable[..., Learned], *arguments: Any, **options: Any) -> Learned | Exception:
    try:
        return function(*arguments, **options)
    except Exception as error:
        return error


BODIES: Registry[Body] = Registry("bodies", modules("neuspring.twin.bodies", "body"), type=Body)


def code(*bodies: str) -> tuple[str, ...]:
    """Modules of some bodies, or of all, and of loss terms of packages: for digests of what treats their twins."""
    modules = [*map(BODIES.module_of, bodies or BODIES), *map(TERMS.module_of, TERMS)]
    return tuple(dict.fromkeys(name for name in modules if name != "neuspring.twin.losses"))


def body_of(twin: Twin) -> Body:
    """The body of a twin: the last registered one that describes it, so that a package's body goes before ours."""
    return next(body for body in reversed(list(BODIES.values())) if body.describes(twin))


def lines_of(twin: Twin) -> Lines:
    """All lines of a twin."""
    return body_of(twin).lines(twin)


def with_mass(twin: Twin, total: float) -> Twin:
    """The twin with so much mass in all, kg, that moves as before: all that is in N or kg is multiplied by the same factor.

    Drags are per mass, and collisions change velocities by ratios of masses.
    """
    masses = lines_of(twin).masses
    own = masses[: len(twin.topology.nodes)]
    if own.all():
        twin = replace(twin, material=replace(twin.material, mass=own))
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
