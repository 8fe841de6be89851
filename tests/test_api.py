"""`import neuspring as ns`: the page's blocks run, and give what the workflow gives."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

import neuspring as ns
from neuspring.baselines import BASELINES, Baseline
from neuspring.config import Fit, Losses
from neuspring.core.errors import InputError
from neuspring.core.files import write_table
from neuspring.scores import metrics
from neuspring.twin import losses
from neuspring.twin.candidates import candidate
from neuspring.twin.fit import TwinFit
from tests.support import played, small

PAGE = Path(ns.__file__).parent / "README.md"
NOTEBOOK = PAGE.with_name("tutorial.ipynb")
DEMO = "results/synthetic_single_lift_sloth/neuspring/0"
CODE = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with results as `make demo` leaves them, of a tiny rope."""
    here = tmp_path_factory.mktemp("api")
    scenario = played.results(here / "results")
    for method in ("baseline", "neuspring"):
        run = ns.load_run(scenario / method / "0")
        assert run.trajectory
        write_table(metrics.score(run.trajectory, run.observations, method, 0), run.folder / "scores.parquet")
    return here


def blocks(text: str) -> list[str]:
    return CODE.findall(text.replace(DEMO, "results/small/neuspring/0"))


def of_notebook() -> str:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    return "".join(f"```python\n{''.join(cell['source'])}\n```\n" for cell in cells if cell["cell_type"] == "code")


@pytest.mark.parametrize("text", [PAGE.read_text().partition("## Templates")[0], of_notebook()], ids=["page", "notebook"])
def test_every_block_runs(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(folder)
    matplotlib.use("Agg")
    names: dict[str, Any] = {}
    for block in blocks(text):
        exec(compile(block, "block", "exec"), names)
    run = names["run"]
    # Rolled out again, a twin moves as the workflow says.
    assert np.allclose(names["predicted"].positions, run.trajectory.positions)
    assert names["pulled"].positions.shape == (46, *run.trajectory.positions.shape[1:])
    assert names["pulled"].positions[-1, :, 2].max() > run.twin.topology.nodes[:, 2].max() + 0.02, "the hands lift it"
    assert len(names["scores"]) == sum(len(ns.load_run(f"results/small/{m}/0").scores) for m in ("baseline", "neuspring"))
    assert "'springs': " in capsys.readouterr().out


def test_the_name_alone_loads_nothing_heavy() -> None:
    code = "import sys, neuspring as ns; print(sorted({'torch', 'warp', 'pandas', 'numpy'} & set(sys.modules)), 'fit' in dir(ns))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "[] True"
    with pytest.raises(AttributeError, match="rollout"):
        ns.rollout  # noqa: B018
    assert all(getattr(ns, name) for name in ns.__all__)


def test_clear_errors(folder: Path) -> None:
    run = ns.load_run(folder / "results/small/neuspring/0")
    count = len(run.twin.topology.controllers)
    with pytest.raises(InputError, match=rf"hands: must be observations, or positions \[T, {count}, 3\] in meters.*\(5, 3\)"):
        ns.roll_out(run.twin, np.zeros((5, 3)))
    with pytest.raises(InputError, match=r"must be the folder of a run.*results/<scenario>/<method>/<seed>"):
        ns.load_run(folder)
    with pytest.raises(InputError, match=r"fit\.epoch: unknown key"):
        ns.fit(run.observations, run.twin, {"fit": {"epoch": 3}})


def test_scores_that_are_missing(tmp_path: Path) -> None:
    run = ns.load_run(played.results(tmp_path) / "neuspring/0")
    with pytest.raises(InputError, match=r"scores.parquet.*Run the workflow again"):
        _ = run.scores


def template(heading: str) -> str:
    return CODE.findall(PAGE.read_text().partition(heading)[2])[0]


def test_template_of_a_baseline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mean_hand.py").write_text(template("**A baseline**"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(BASELINES._loaded, "mean_hand", Baseline(prediction="mean_hand:mean_hand"))
    seen = small.observations()
    predicted = BASELINES["mean_hand"].predict(seen, None, None, "cpu").trajectory
    hands = seen.controller_points.mean(axis=1)
    assert np.allclose(predicted.positions[-1] - predicted.positions[0], hands[-1] - hands[0], atol=1e-6)
    assert len(ns.score(predicted, seen))


def test_template_of_a_loss_term(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "above_table.py").write_text(template("**A loss term**"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(losses.TERMS._own, "above_table", importlib.import_module("above_table").above_table)

    class Weights(Losses):
        above_table: float = 2.0

    problem = small.fit_problem(losses=Weights(chamfer=0.0, track=0.0, acceleration=0.0), fit=Fit(horizon=0))
    twin = candidate(small.search_problem(), small.start_values())
    positions = ns.roll_out(twin, small.observations(), "cpu").positions[1 : small.observations().scenario.train_end]
    # Lowered by 1 m, everything is below the table.
    lowered = positions[..., 2] - 1.0
    loss = losses.FrameLoss.of(small.observations(), problem.losses, "cpu")
    import torch

    values = [float(loss(frame + 1, torch.tensor(x - [0, 0, 1.0], dtype=torch.float32))) for frame, x in enumerate(positions)]
    assert values == pytest.approx((2.0 * (lowered**2).mean(axis=1)).tolist(), rel=1e-5)
    assert TwinFit(problem).epoch()["loss"] == pytest.approx(0.0, abs=1e-3)
