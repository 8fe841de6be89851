"""The first-order stage: recovery on exact data, horizons, exact continuation, rollback, quirks."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import pearsonr

from neuspring import config
from neuspring import fit as module
from neuspring.errors import NumericalFailure
from neuspring.fit import FitProblem, SpringFit, fit
from neuspring.physics import stability
from tests import small


def true_problem(**settings) -> FitProblem:
    """The true topology and damping, with the stiffness made homogeneous: only it is to be found."""
    truth = small.scene().truth
    mean = np.full_like(truth.material.stiffness, 1.2e4)
    start = replace(truth, material=replace(truth.material, stiffness=mean))
    return small.fit_problem(twin=start, fit=config.Fit(**({"epochs": 12, "learning_rate": 3e-2} | settings)))


@pytest.mark.parametrize("horizon", [1, 3, 0])
def test_training_lowers_the_loss_on_exact_data(horizon):
    result = fit(true_problem(horizon=horizon))
    losses = result.history["loss"]
    assert losses.iloc[-1] < 0.7 * losses.iloc[0]
    assert result.rollbacks == []


def test_the_whole_horizon_gradient_moves_stiffness_towards_the_truth():
    truth = np.log(small.scene().truth.material.stiffness)
    result = fit(true_problem(horizon=0, epochs=30, learning_rate=5e-2))
    found = np.log(result.twin.material.stiffness)
    start = np.log(1.2e4)
    moved = np.abs(found - start) > 0.05
    assert moved.sum() > 100
    # Eight frames do not determine every spring, but the ones that moved cannot have moved this way by chance.
    correlation = pearsonr(found[moved], truth[moved])
    assert correlation.statistic > 0
    assert correlation.pvalue < 1e-6
    assert result.history["loss"].iloc[-1] < 0.1 * result.history["loss"].iloc[0]


GROWING = {"fit": config.Fit(epochs=12, learning_rate=0.3, horizon=0, checkpoint_every=1)}


@pytest.mark.parametrize(("changes", "killed_in"), [({}, 3), (GROWING, 8), (GROWING, 10)])
def test_a_killed_fit_continues_bit_for_bit(tmp_path, monkeypatch, changes, killed_in):
    whole = fit(small.fit_problem(**changes))
    partial = tmp_path / "fit.npz"
    epochs = 0
    run_epoch = SpringFit.epoch

    def dying(self):
        nonlocal epochs
        epochs += 1
        if epochs == killed_in:
            raise KeyboardInterrupt
        return run_epoch(self)

    with monkeypatch.context() as patch:
        patch.setattr(SpringFit, "epoch", dying)
        with pytest.raises(KeyboardInterrupt):
            fit(small.fit_problem(**changes), partial=partial, key="k")
    continued = fit(small.fit_problem(**changes), partial=partial, key="k")
    assert (whole.attempts, continued.attempts) == (1, 2)
    np.testing.assert_array_equal(continued.twin.material.stiffness, whole.twin.material.stiffness)
    assert continued.twin.simulation == whole.twin.simulation
    pd.testing.assert_frame_equal(continued.history, whole.history, check_exact=True)


def test_a_checkpoint_of_another_problem_is_ignored(tmp_path, capsys):
    partial = tmp_path / "fit.npz"
    fit(small.fit_problem(), partial=partial, key="one")
    assert fit(small.fit_problem(), partial=partial, key="two").attempts == 1
    assert "other inputs or settings" in capsys.readouterr().out


def test_a_non_finite_gradient_rolls_back_and_is_reported(monkeypatch):
    problem = small.fit_problem()
    calls = 0
    real = module.simulate_frame

    def poisoned(*arguments):
        nonlocal calls
        calls += 1
        x, v = real(*arguments)
        return (x * float("nan"), v) if calls == 7 else (x, v)  # in the second epoch: 4 training frames each

    monkeypatch.setattr(module, "simulate_frame", poisoned)
    result = fit(problem)
    assert len(result.rollbacks) == 1
    assert "epoch 1: the loss is not finite in frames 3 to 3" in result.rollbacks[0]
    rows = result.history
    assert rows["rolled_back"].tolist() == [False, True, False]
    assert rows["learning_rate"].tolist() == [0.05, 0.05, 0.025]
    assert np.isfinite(result.twin.material.stiffness).all()


def test_a_fit_that_never_completes_an_epoch_is_a_named_failure(monkeypatch):
    monkeypatch.setattr(module, "simulate_frame", lambda s, p, x, v, b, e: (x * float("nan"), v))
    with pytest.raises(NumericalFailure, match=r"no epoch could be completed: epoch 0: the loss is not finite"):
        fit(small.fit_problem(fit=config.Fit(epochs=10)))


def test_gradient_clipping_limits_the_step():
    # Plain momentum-free Adam normalises steps, so clipping shows in its first moment, not in the step.
    runs = {}
    for limit in (0.0, 1e-9):
        run = SpringFit(small.fit_problem(fit=config.Fit(epochs=1, clip_gradient_norm=limit, betas=(0.0, 0.0))))
        run.epoch()
        runs[limit] = np.linalg.norm(run.moments()["0.exp_avg"])
    assert runs[1e-9] <= 1.01e-9 < runs[0.0]


def test_stiffness_stays_within_its_clamp():
    limit = (0.0, 7e3)
    result = fit(small.fit_problem(fit=config.Fit(epochs=4, learning_rate=0.3, stiffness_range=limit)))
    assert result.twin.material.stiffness.max() <= 7e3


def test_stiffening_springs_get_more_substeps():
    problem = small.fit_problem(**GROWING)
    result = fit(problem)
    assert result.twin.material.stiffness.max() > 2 * problem.twin.material.stiffness.max()
    assert result.twin.simulation.substeps > problem.twin.simulation.substeps
    stability.check(result.twin)


def limited(kind: str) -> dict[str, object]:
    """Settings under which stiffness outgrows the substeps that it may have."""
    start = small.fit_problem(**GROWING).twin
    count = start.simulation.substeps
    if kind == "fixed":
        return GROWING | {"simulation": config.Simulation(substeps=count)}
    return GROWING | {"simulation": config.Simulation(max_substeps=count)}


@pytest.mark.parametrize("kind", ["fixed", "max_substeps"])
def test_stiffness_beyond_the_allowed_substeps_rolls_back_and_recovers(kind):
    problem = small.fit_problem(**limited(kind))
    result = fit(problem)
    assert any("stiffness grew beyond" in text for text in result.rollbacks)
    # The learning rate is halved, so training goes on after a rollback ...
    rolled = result.history["rolled_back"].tolist()
    assert not all(rolled[rolled.index(True) :])
    # ... and what comes out can be rolled out as it is.
    assert result.twin.simulation.substeps == problem.twin.simulation.substeps
    stability.check(result.twin)


def test_the_best_epoch_by_training_loss_wins_and_the_quirk_looks_every_20_epochs():
    result = fit(small.fit_problem())
    assert result.best_epoch == result.history["loss"].idxmin()
    quirks = config.ReleasedQuirks(sparse_checkpoints=True)
    eligible = [e for e in range(30) if module._eligible(e, small.fit_problem(quirks=quirks, fit=config.Fit(epochs=30)))]
    assert eligible == [0, 20, 29]


def test_the_future_is_never_read():
    first, second = fit(small.fit_problem()), fit(small.fit_problem(small.spoiled_future()))
    np.testing.assert_array_equal(first.twin.material.stiffness, second.twin.material.stiffness)


def test_training_is_deterministic_whatever_torch_drew_before():
    torch.manual_seed(1)
    first = fit(small.fit_problem())
    torch.manual_seed(2)
    second = fit(small.fit_problem())
    np.testing.assert_array_equal(first.twin.material.stiffness, second.twin.material.stiffness)
