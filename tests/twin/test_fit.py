"""The first-order stage: recovery on exact data, horizons, selection, schedules, exact continuation, rollback, quirks."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import pearsonr

from neuspring import config
from neuspring.core.artifacts import SCALARS, Observations, Twin
from neuspring.core.errors import NumericalFailure
from neuspring.physics import stability
from neuspring.twin import batch
from neuspring.twin import fit as module
from neuspring.twin.fit import FitProblem, TwinFit, fit
from neuspring.twin.losses import FrameLoss
from neuspring.twin.rollout import roll_out
from tests.support import small

MEAN = 1e-6
"""Relative: a mean of losses in float32, summed in another order."""
FIELD = config.SpringFieldSettings()


@pytest.fixture(autouse=True)
def small_field(monkeypatch):
    """Fields small enough for tests."""
    for name, value in {"FIELD_CHANNELS": 4, "FIELD_HIDDEN": 16, "FIELD_BANDS": 2}.items():
        monkeypatch.setattr(f"neuspring.twin.field.{name}", value)


def true_problem(**settings) -> FitProblem:
    """The true topology and damping, with the stiffness made homogeneous: only it is to be found."""
    truth = small.scene().truth
    mean = np.full_like(truth.material.stiffness, 1.2e4)
    start = replace(truth, material=replace(truth.material, stiffness=mean))
    return small.fit_problem(twin=start, fit=config.Fit(**({"epochs": 12, "learning_rate": 3e-2} | settings)))


def field_fit(**settings) -> config.Fit:
    """Settings of a fit of a small field."""
    return config.Fit(**({"epochs": 5, "learning_rate": 1e-2, "field": FIELD} | settings))


@pytest.mark.parametrize(("field", "horizon"), [({}, 1), ({"triplane": False}, 0)], ids=str)
def test_a_field_lowers_the_loss(field, horizon):
    settings = field_fit(
        epochs=8 if horizon else 12,
        learning_rate=5e-3 if horizon else 1e-2,
        horizon=horizon,
        output_bound=1.5,
        field=replace(FIELD, **field),
    )
    result = fit(replace(true_problem(), fit=settings, kind="field"))
    losses = result.history["loss"]
    assert losses.iloc[-1] < 0.7 * losses.iloc[0]
    assert result.facts["rollbacks"] == []
    assert result.twin.material.stiffness.std() > 10.0, "not one factor for all"


def test_the_whole_horizon_gradient_moves_stiffness_towards_the_truth():
    truth = np.log(small.scene().truth.material.stiffness)
    result = fit(true_problem(horizon=0, epochs=30, learning_rate=5e-2))
    log_stiffness = np.log(result.twin.material.stiffness)
    start = np.log(1.2e4)
    moved = np.abs(log_stiffness - start) > 0.05
    assert moved.sum() > 100
    # Eight frames do not determine every spring, but the ones that moved cannot have moved this way by chance.
    correlation = pearsonr(log_stiffness[moved], truth[moved])
    assert correlation.statistic > 0
    assert correlation.pvalue < 1e-6
    assert result.history["loss"].iloc[-1] < 0.1 * result.history["loss"].iloc[0]


GROWING = {"fit": config.Fit(epochs=12, learning_rate=0.3, horizon=0)}
EVERYTHING = {
    "kind": "field",
    "fit": field_fit(
        epochs=4,
        global_stiffness=True,
        controller_factors=True,
        damping="homogeneous",
        output_bound=1.5,
        selection="tail",
    ),
}
LIMITED = {"fit": config.Fit(epochs=4, learning_rate=0.3)}
"""With 70 substeps at most they grow within the second epoch, until it is rolled back because they may not grow further."""


@pytest.mark.parametrize(
    ("changes", "killed_in", "most_substeps"),
    [(GROWING, 10, 2000), (EVERYTHING, 3, 2000), (LIMITED, 3, 70)],
)
def test_a_killed_fit_continues_bit_for_bit(tmp_path, monkeypatch, changes, killed_in, most_substeps):
    monkeypatch.setattr("neuspring.core.checkpoint.CHECKPOINT_EVERY", 1)
    monkeypatch.setattr(stability, "MAX_SUBSTEPS", most_substeps)
    whole = fit(small.fit_problem(**changes))
    partial = tmp_path / "fit.npz"
    epochs = 0
    run_epoch = TwinFit.epoch

    def dying(self):
        nonlocal epochs
        epochs += 1
        if epochs == killed_in:
            raise KeyboardInterrupt
        return run_epoch(self)

    with monkeypatch.context() as patch:
        patch.setattr(TwinFit, "epoch", dying)
        with pytest.raises(KeyboardInterrupt):
            fit(small.fit_problem(**changes), partial=partial, key="k")
    continued = fit(small.fit_problem(**changes), partial=partial, key="k")
    assert (whole.attempts, continued.attempts) == (1, 2)
    assert_same_twin(continued.twin, whole.twin)
    pd.testing.assert_frame_equal(continued.history, whole.history, check_exact=True)
    assert continued.facts == whole.facts


def assert_same_twin(twin: Twin, expected: Twin):
    """Everything that a fit may change is equal, bit for bit."""
    assert twin.simulation == expected.simulation
    for name in ("stiffness", "dashpot"):
        np.testing.assert_array_equal(getattr(twin.material, name), getattr(expected.material, name))
    np.testing.assert_array_equal(twin.topology.rest_lengths, expected.topology.rest_lengths)
    for name in SCALARS:
        # The physics is computed in single precision, so a fit rounds scalars to it.
        assert np.float32(getattr(twin.material, name)) == np.float32(getattr(expected.material, name)), name


def test_a_non_finite_gradient_rolls_back_and_is_reported(monkeypatch):
    problem = small.fit_problem()
    calls = 0
    real = batch.simulate_frame

    def poisoned(*arguments):
        nonlocal calls
        calls += 1
        x, v = real(*arguments)
        return (
            (x * float("nan"), v) if calls == 11 else (x, v)
        )  # in the second epoch: 4 training frames each, after the rollout of the start

    monkeypatch.setattr(batch, "simulate_frame", poisoned)
    result = fit(problem)
    assert len(result.facts["rollbacks"]) == 1
    assert "epoch 1: the loss is not finite in frames 3 to 3" in result.facts["rollbacks"][0]
    rows = result.history
    assert rows["rolled_back"].tolist() == [False, True, False]
    assert rows["learning_rate"].tolist() == [0.05, 0.05, 0.025]
    assert np.isfinite(result.twin.material.stiffness).all()


@pytest.mark.parametrize("settings", [{}, {"selection": "tail"}, {"selection": "tail", "horizon": 0}], ids=str)
def test_a_fit_that_never_completes_an_epoch_is_a_named_failure(monkeypatch, settings):
    monkeypatch.setattr(batch, "simulate_frame", lambda solver, values, x, v, *_: (x * float("nan"), v))
    with pytest.raises(NumericalFailure, match=r"no epoch could be completed: epoch 0: the loss is not finite"):
        fit(small.fit_problem(fit=config.Fit(epochs=10, **settings)))


@pytest.mark.parametrize(("limit", "horizon", "left_out"), [(1e-9, 0, 12), (1e-9, 1, 0), (1e9, 0, 0)])
def test_frames_beyond_the_limit_of_adjoints_are_left_out_and_counted(limit, horizon, left_out, monkeypatch):
    """Three epochs of four frames. A single frame per step is the released method, which has no limit."""
    settings = {"epochs": 3, "learning_rate": 0.05, "horizon": horizon}
    monkeypatch.setattr(module, "ADJOINT_LIMIT", limit)
    problem = small.fit_problem(fit=config.Fit(**settings))
    result = fit(problem)
    assert result.history["frames_left_out"].sum() == left_out
    assert np.any(result.twin.material.stiffness != problem.twin.material.stiffness) == (left_out == 0)


@pytest.mark.parametrize("kind", ["springs", "field"])
def test_substeps_grow_within_an_epoch(kind):
    """One epoch of four steps, so long that the last frames could not be integrated with the first substeps."""
    settings = field_fit(epochs=1, learning_rate={"springs": 0.5, "field": 0.05}[kind], selection="training_loss")
    problem = small.fit_problem(fit=settings, kind=kind)
    result = fit(problem)
    assert result.facts["rollbacks"] == []
    assert result.twin.simulation.substeps > problem.twin.simulation.substeps
    stability.check(result.twin)
    run = TwinFit(problem)
    run.set_rate(1.0)
    assert np.isfinite(small.done(run.epoch())["loss"])
    assert run.twin.simulation.substeps > problem.twin.simulation.substeps, "before the epoch's end"


def test_growing_dashpots_get_more_substeps():
    start = small.fit_problem().twin
    damped = replace(start, material=replace(start.material, dashpot=np.full_like(start.material.dashpot, 40.0)))
    run = TwinFit(small.fit_problem(twin=damped, fit=config.Fit(damping="homogeneous")))
    before = stability.smallest_safe_substeps(stability.twin_spectrum(damped), damped.simulation.frame_time, 0.8)
    run.use_substeps(before)
    run.require_stable()
    assert run.twin.simulation.substeps == before
    with torch.no_grad():
        run.parameters.factors["dashpot"].fill_(math.log(3.0))
    run.require_stable()
    assert run.twin.simulation.substeps > before
    stability.check(run.parameters.as_twin(run.twin))


@pytest.mark.parametrize("kind", ["fixed", "auto"])
def test_stiffness_beyond_the_allowed_substeps_rolls_back_and_recovers(kind, monkeypatch):
    count = small.fit_problem(**GROWING).twin.simulation.substeps
    monkeypatch.setattr(stability, "MAX_SUBSTEPS", count)
    substeps = count if kind == "fixed" else "auto"
    problem = small.fit_problem(**GROWING, simulation=config.SimulationSettings(substeps=substeps))
    result = fit(problem)
    assert any("stiffness grew beyond" in text for text in result.facts["rollbacks"])
    # The learning rate is halved, so training goes on after a rollback ...
    rolled = result.history["rolled_back"].tolist()
    assert not all(rolled[rolled.index(True) :])
    # ... and what comes out can be rolled out as it is.
    assert result.twin.simulation.substeps == problem.twin.simulation.substeps
    stability.check(result.twin)


def test_the_future_is_never_read():
    changes = EVERYTHING | {"simulation": config.SimulationSettings(initial_velocity="observed")}
    first, second = (fit(small.fit_problem(seen, **changes)) for seen in (small.observations(), small.spoiled_future()))
    assert_same_twin(first.twin, second.twin)
    pd.testing.assert_frame_equal(first.history, second.history, check_exact=True)


# Which epoch wins -----------------------------------------------------------------------------------------------------


def observed_as(twin: Twin, first: int) -> Observations:
    """The default scene, in which training frames from `first` on show exactly what `twin` does."""
    seen = small.observations()
    predicted = roll_out(twin, seen.controller_points).positions[:, : seen.object_points.shape[1]]
    points = seen.object_points.copy()
    points[first : seen.scenario.train_end] = predicted[first : seen.scenario.train_end]
    return replace(seen, object_points=points)


def loss_of(twin: Twin, seen: Observations, frames: range) -> float:
    """Mean loss of a rollout over some frames, m^2."""
    loss = FrameLoss.of(seen, config.Losses(), "cpu")
    positions = torch.tensor(roll_out(twin, seen.controller_points).positions)
    return float(torch.stack([loss(frame, positions[frame]) for frame in frames]).mean())


@pytest.mark.parametrize("kind", ["springs", "field"])
def test_the_held_back_tail_selects_and_is_not_trained_on(kind, monkeypatch):
    """Half of the four training frames are held back. Where they show what the start does, the start wins."""
    monkeypatch.setattr(module, "TAIL_FRACTION", 0.5)
    monkeypatch.setattr(module, "ROLLOUT_EVERY", 1)
    settings = field_fit(selection="tail")
    start = small.fit_problem().twin
    problems = [small.fit_problem(seen, fit=settings, kind=kind) for seen in (small.observations(), observed_as(start, 3))]
    learned, stayed = (fit(problem) for problem in problems)
    for column in ("loss", "gradient_norm", "learning_rate"):
        assert learned.history[column].tolist() == stayed.history[column].tolist()
    assert learned.history["rollout_loss"].tolist() != stayed.history["rollout_loss"].tolist()
    assert learned.facts["best_epoch"] > 0
    assert stayed.facts["best_epoch"] == -1
    assert_same_twin(stayed.twin, start)
    assert stayed.facts["rollout_loss"] == pytest.approx(0, abs=1e-12)
    # What selected is the loss of the twin that comes out, over the frames held back.
    assert learned.facts["rollout_loss"] == pytest.approx(loss_of(learned.twin, small.observations(), range(3, 5)), rel=MEAN)
    assert learned.facts["rollout_loss"] == learned.history["rollout_loss"].min()


@pytest.mark.parametrize("kind", ["springs", "field"])
@pytest.mark.parametrize(("horizon", "rate", "better"), [(1, 1e-2, True), (0, 1e-2, True), (1, 3.0, False)])
def test_no_fit_ends_behind_its_search_and_its_loss_is_that_of_its_rollout(kind, horizon, rate, better):
    problem = small.fit_problem(fit=field_fit(epochs=6, learning_rate=rate, horizon=horizon), kind=kind)
    result = fit(problem)
    facts, seen = result.facts, small.observations()
    assert (facts["best_epoch"] >= 0) == (facts["rollout_loss"] < facts["search_loss"]) == better
    for twin, loss in ((problem.twin, facts["search_loss"]), (result.twin, facts["rollout_loss"])):
        assert loss == pytest.approx(loss_of(twin, seen, range(1, 5)), rel=1e-5)
    assert result.history["rollout_loss"].notna().tolist() == [False] * 4 + (~result.history["rolled_back"][4:]).tolist()
    released = fit(replace(problem, fit=replace(problem.fit, selection="training_loss")))
    assert released.facts["best_epoch"] == released.history["loss"].argmin()


def test_a_rollout_that_cannot_be_made_loses_no_fit(monkeypatch):
    def broken(self):
        raise module.NonFinite("broken")
        yield

    monkeypatch.setattr(TwinFit, "rollout_loss", broken)
    facts = fit(small.fit_problem(fit=config.Fit(epochs=2, learning_rate=1e-2, selection="training_loss"))).facts
    assert (facts["search_loss"], facts["rollout_loss"], facts["best_epoch"] >= 0) == (None, None, True)


def test_a_fit_ends_when_rollouts_have_stopped_falling(monkeypatch):
    monkeypatch.setattr(module, "ROLLOUT_EVERY", 2)
    monkeypatch.setattr(module, "PLATEAU_EPOCHS", 4)
    slow, learning, all_epochs = (
        fit(small.fit_problem(fit=config.Fit(epochs=7, learning_rate=rate, plateau=plateau, decay_epochs=2)))
        for rate, plateau in ((3e-2, 0.9), (3e-2, 0.01), (1e-7, 0.0))
    )
    assert [(one.facts["epochs"], one.facts["converged"]) for one in (slow, learning, all_epochs)] == [
        (4, True),
        (7, False),
        (7, False),
    ]
    assert learning.history["learning_rate"][2] == pytest.approx(3e-2 / 2)


# Learning rates -------------------------------------------------------------------------------------------------------


def test_rollbacks_scale_every_rate_and_the_rate_is_the_step_that_is_taken():
    """The first step of Adam is the learning rate itself, but for its epsilon, 1e-3 of the largest gradient here."""
    run = TwinFit(small.fit_problem(fit=config.Fit(learning_rate=0.1, horizon=0)))
    run.set_rate(0.25)
    assert {group["lr"] for group in run.optimizer.param_groups} == {0.25 * 0.1}
    small.done(run.epoch())
    assert run.parameters.offsets.abs().max().item() == pytest.approx(0.1 / 4, rel=1e-2)
