"""Small toy captures and settings, cheap enough for tests that search, fit and run the workflow."""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from neuspring import config
from neuspring.core.artifacts import Observations, Twin
from neuspring.scenes import toy
from neuspring.twin.batch import Course, SharedFrames, lockstep, result_of
from neuspring.twin.candidates import SearchProblem, candidate, evaluate
from neuspring.twin.fit import FitProblem, FitResult
from neuspring.twin.losses import FrameLoss
from neuspring.twin.trials import Outcome, Rollouts, rolled

FRAMES = 8


def row(path: str = "rope/lift/smooth", name: str = "small") -> config.ScenarioRow:
    """A row of the scenario table for a toy scene."""
    return config.ScenarioRow(scenario=name, source="toy", category="rope", path=path, self_collision=False, ground=True)


@functools.cache
def scene(path: str = "rope/lift/smooth", noise: float = 0.0, occlusion: float = 0.0, frames: int = FRAMES) -> toy.ToyScene:
    """A toy scene of a few frames."""
    return toy.make(row(path), toy.ToyObservation(frames=frames, noise=noise, occlusion=occlusion))


def observations() -> Observations:
    """Exact observations of the default scene."""
    return scene().observations


def spoiled_future() -> Observations:
    """The default scene with everything that a method must not read made wrong: all arrays after the split, and the tracks."""
    seen = observations()
    changed = {}
    for name in ("object_points", "controller_points"):
        values = getattr(seen, name).copy()
        values[seen.scenario.train_end :] += 1.0
        changed[name] = values
    # Motion of the last training frame is about its way into the future.
    for name, first in (("object_visibility", seen.scenario.train_end), ("object_motion_valid", seen.scenario.train_end - 1)):
        values = getattr(seen, name).copy()
        values[first:] ^= True
        changed[name] = values
    return replace(seen, **changed, tracks=seen.tracks + 1.0)


@functools.cache
def _released() -> dict[str, object]:
    rows = config.read_yaml(Path(__file__).parents[2] / "config" / "searches.yaml")
    return {key: value for key, value in rows["released_quirks"]["settings"].items() if key != "isolated_nodes"}


def variables(ranges: Mapping[str, Any] = {}, scales: Mapping[str, str] = {}, start: Mapping[str, float] = {}) -> dict[str, Any]:
    """Settings of variables by name: [low, high], scales, starts."""
    names = {*ranges, *scales, *start}
    bounds = {name: dict(zip(("low", "high"), ranges[name], strict=True)) for name in ranges}
    others = {"scale": scales, "start": start}
    return {name: bounds.get(name, {}) | {key: values[name] for key, values in others.items() if name in values} for name in names}


def released(
    ranges: Mapping[str, Any] = {}, scales: Mapping[str, str] = {}, start: Mapping[str, float] = {}, **changes: object
) -> config.Search:
    """The settings of the released search (config/searches.yaml); `changes` replace keys, those of sections are merged."""
    values = copy.deepcopy(_released())
    config.merge(values, {"variables": variables(ranges, scales, start)} | changes)
    return config.parse(config.Search, values, "test")


def search_problem(seen: Observations | None = None, **changes: object) -> SearchProblem:
    """A released search of two generations; `changes` replace fields of SearchProblem."""
    settings: dict[str, object] = {
        "observations": seen or observations(),
        "search": released(rollouts=22, start={"object_radius": 0.045, "stiffness": 1e4}),
        "simulation": config.SimulationSettings(),
        "losses": config.Losses(),
        "quirks": config.ReleasedQuirks(),
    }
    return SearchProblem(**(settings | changes))  # type: ignore[arg-type]


def judge(problem: SearchProblem, twins: Sequence[Twin], loss: FrameLoss) -> list[Outcome]:
    """Results of candidates that are rolled out together over the training frames."""
    own = problem.recordings[0]
    return rolled([Rollouts(twins, own.hands, own.velocity, loss)], problem.device)[0]


def done(course: Course) -> Any:
    """The result of a part of a fit that yields frames and gradients."""
    return result_of(lockstep([course], SharedFrames().serve))


def evaluated(problem: SearchProblem, population: Sequence[np.ndarray]) -> list[dict[str, Any]]:
    """Rows of candidates whose hands hold."""
    course = evaluate(problem, population, False, 0, 0)
    return result_of(lockstep([course], lambda asked: {0: [(rolled([one], problem.device)[0], 0.0) for one in asked[0]]}))


def rollout_loss(loss: FrameLoss, states: Iterable[tuple[int, torch.Tensor, torch.Tensor]], velocity: torch.Tensor) -> float:
    """Mean loss of the frames (frame, x, v) of a rollout from `velocity` [N, 3] on, acceleration included."""
    total, count, previous = 0.0, 0, None
    for frame, x, v in states:
        change = v - velocity
        jerk = None if previous is None else change - previous
        total += sum(float(term) for term in loss.terms(frame, x, jerk).values())
        velocity, previous, count = v, change, count + 1
    return total / count


def start_values() -> dict[str, float]:
    """Physical values near the truth of the default scene, stiffness too low."""
    own = {"object_radius": 0.045, "object_neighbors": 18.0, "stiffness": 6e3, "drag": 1.0, "dashpot": 20.0}
    return {name: one["start"] for name, one in config.plain(released(start=own).variables).items()}


def fit_problem(seen: Observations | None = None, values: dict[str, float] | None = None, **changes: object) -> FitProblem:
    """A short fit from `start_values`; `changes` replace fields of FitProblem."""
    search = search_problem(seen)
    settings: dict[str, object] = {
        "observations": search.observations,
        "twin": candidate(search, values or start_values()),
        "fit": config.Fit(epochs=3, learning_rate=5e-2),
        "simulation": search.simulation,
        "losses": search.losses,
        "quirks": search.quirks,
    }
    return FitProblem(**(settings | changes))  # type: ignore[arg-type]


def assert_same_fit(got: FitResult | Exception, wanted: FitResult):
    """Equal histories and twins, bit for bit."""
    assert isinstance(got, FitResult), got
    pd.testing.assert_frame_equal(got.history, wanted.history, check_exact=True)
    for name in ("best_epoch", "rollout_loss", "rollbacks"):
        assert got.facts[name] == wanted.facts[name]
    assert got.twin.simulation == wanted.twin.simulation
    for part in ("topology", "material"):
        for name, value in vars(getattr(wanted.twin, part)).items():
            np.testing.assert_array_equal(getattr(getattr(got.twin, part), name), value, err_msg=name)
