"""How large a simulation is before it runs: springs and substeps, each with what it rests on.

A job that simulates takes time in proportion to its spring updates,

    updates = frames x substeps x springs,

where frames are those that its twins are simulated over: rollouts x training frames (search), epochs x training frames (fit,
forward and backward), frames (rollout, transfer). Sources, best first:

| | springs | substeps |
|---|---|---|
| fixed | | 667 (`released_quirks.frame_time_667`), or `simulation.substeps` |
| record | a search of the scenario in this results folder | the same |
| others | | median of the same search on other scenarios of this folder |
| settings | N and C of observations.npz, else as the source expects them, with the search's start | the search's start |

The search's start has Y [N], dashpot [N s/m], radii r, r_c [m; without the reach of controllers where `search.lengths` is spacing]
and neighbor counts n, n_c. On a surface with a node every h meters,

    springs = N d / 2 + C min(n_c, pi (r_c / h)^2),        d = min(n - 1, pi (r / h)^2) neighbors of a node,
    substeps = frame time / dt,                            dt^2 K + 2 dt D = 4 safety,  K = d Y / l0,  D = d dashpot,

with l0 two thirds of the radius of a disk that holds d nodes: the bound of `neuspring.physics.stability` with the forces of half of
the springs along each direction.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from neuspring.config import Search, Simulation
from neuspring.core.errors import InputError
from neuspring.core.job_records import SPRING_UPDATES
from neuspring.core.npz import DamagedFile
from neuspring.core.npz_head import read_head
from neuspring.core.records import StageRecord
from neuspring.data.expected import Expected, expected
from neuspring.experiments import benchmark as benchmarks
from neuspring.experiments.benchmark import Benchmark

RELEASED_SUBSTEPS = 667
TRAIN = 0.7
"""Part of the frames that is for training, where only the count of frames is known."""
RECORD, OTHERS, FIXED = "the search's record", "searches of other scenarios", "the configuration"
OBSERVED, SETTINGS = "the nodes observed and the settings", "the settings"


@dataclass(frozen=True, kw_only=True)
class Size:
    """Of one scenario's twins, with one search's settings."""

    springs: float
    substeps: float
    springs_from: str
    substeps_from: str

    @property
    def updates(self) -> float:
        """Spring updates per frame."""
        return self.springs * self.substeps


@dataclass(frozen=True, kw_only=True)
class Body(Expected):
    """A scenario's body and recording, and what that rests on."""

    train_end: int
    source: str


class Sizes:
    """Sizes of a benchmark's twins. Every file is read once: one record per scenario and search, one head per scenario."""

    def __init__(self, benchmark: Benchmark) -> None:
        self._benchmark, self._results = benchmark, Path(benchmark.config.results)
        self.body = cache(self._body)
        """Scenario -> its body: from the head of its observations, where there are some, else as its source expects it."""
        self.of = cache(self._size)
        """(scenario, search, candidates) -> the size of the twin that the search finds, or the mean of those that it tries."""
        self._recorded = cache(self._facts)
        self._substeps_of_others = cache(self._median)

    def _size(self, scenario: str, search: str, candidates: bool) -> Size:
        config, body = self._benchmark.config, self.body(scenario)
        row = self._benchmark.searches[search]
        settings, quirks = benchmarks.search_of(config, row, search), benchmarks.quirks_of(config, row, search)
        springs, substeps = expected_size(body, settings, config.simulation)
        springs_from, substeps_from = body.source, SETTINGS
        facts = self._recorded(scenario, search)
        if facts:
            substeps = facts["substeps"]
            # The candidates of a search have other springs and substeps than the best of them; their mean product is what counts.
            springs = facts["updates"] / substeps if candidates else facts["springs"]
            springs_from = substeps_from = RECORD
        elif others := self._substeps_of_others(search):
            substeps, substeps_from = others, OTHERS
        fixed = RELEASED_SUBSTEPS if quirks.frame_time_667 else config.simulation.substeps
        if fixed != "auto":
            substeps, substeps_from = float(fixed), FIXED
        return Size(springs=springs, substeps=substeps, springs_from=springs_from, substeps_from=substeps_from)

    def _body(self, scenario: str) -> Body:
        known = expected(self._benchmark.scenarios[scenario], self._benchmark.config)
        try:
            shapes, meta = read_head(self._results / scenario / "observations.npz")
            recording = meta["fields"]["scenario"]
            return Body(
                nodes=shapes["object_points"][1] + shapes["surface_points"][0] + shapes["interior_points"][0],
                spacing=known.spacing,
                frames=recording["frame_count"],
                controllers=shapes["controller_points"][1],
                frame_rate=recording["frame_rate"],
                train_end=recording["train_end"],
                source=OBSERVED,
            )
        except (FileNotFoundError, DamagedFile, LookupError, TypeError):
            # None yet, or damaged ones, which the jobs that read them name.
            return Body(**asdict(known), train_end=math.ceil(TRAIN * known.frames), source=SETTINGS)

    def _median(self, search: str) -> float | None:
        """The median substeps of a search over the scenarios that have it; None where none has."""
        found = [facts["substeps"] for name in self._benchmark.scenarios if (facts := self._recorded(name, search))]
        return statistics.median(found) if found else None

    def _facts(self, scenario: str, search: str) -> dict[str, float] | None:
        """Sizes in the record of a search, of the first seed that has one; None without, or if it is of other observations."""
        folder, body = self._results / scenario / f"search-{search}", self.body(scenario)
        paths = (folder / str(seed) / "search.json" for seed in self._benchmark.whole.seeds)
        path = next((path for path in paths if path.exists()), None)
        if path is None or body.source != OBSERVED:
            return None
        try:
            facts = StageRecord.load(path).facts
            if facts["nodes"] != body.nodes:
                return None
            simulated = facts["rollouts"] * (body.train_end - 1)
            updates = facts.get(SPRING_UPDATES, facts["springs"] * facts["substeps"] * simulated) / simulated
            return {"springs": float(facts["springs"]), "substeps": float(facts["substeps"]), "updates": updates}
        except (InputError, KeyError):
            # Damaged, or of a search that failed.
            return None


def expected_size(body: Expected, search: Search, simulation: Simulation) -> tuple[float, float]:
    """(springs, substeps) of a body at the start of a search, by the equations above; at most `simulation.max_substeps`."""
    start, spacing = search.start, body.spacing
    # How far controllers are from the nodes is not known before there are observations.
    unit = spacing if search.lengths == "meter" else 1.0
    neighbors = min(start.object_neighbors - 1, math.pi * (start.object_radius / unit) ** 2)
    held = min(start.controller_neighbors, math.pi * (start.controller_radius / unit) ** 2, body.nodes)
    neighbors = min(neighbors, body.nodes - 1)
    length = 2 / 3 * spacing * math.sqrt(neighbors / math.pi)
    stiffness, damping = neighbors * start.stiffness / length, neighbors * start.dashpot
    # dt = 1 / x, with x the positive root of 4 safety x^2 - 2 D x - K = 0.
    limit = 4 * simulation.safety
    per_second = (damping + math.sqrt(damping**2 + limit * stiffness)) / limit
    springs = body.nodes * neighbors / 2 + body.controllers * held
    return springs, min(float(int(per_second / body.frame_rate) + 1), float(simulation.max_substeps))
