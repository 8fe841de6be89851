"""`import neuspring as ns`: the page's blocks run, and give what the workflow gives."""

import dataclasses
import importlib
import importlib.util
import io
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from PIL import Image

import neuspring as ns
from neuspring.baselines import BASELINES, Baseline
from neuspring.config import Fit, Losses, Search
from neuspring.core.errors import InputError
from neuspring.core.files import write_table
from neuspring.scores import metrics
from neuspring.twin import losses
from neuspring.twin.candidates import candidate
from neuspring.twin.fit import TwinFit
from tests.support import perceived, played, small
from tests.support.filmed import film

PAGE = Path(ns.__file__).parent / "README.md"
NOTEBOOK = PAGE.with_name("tutorial.ipynb")
PACKAGED, OWN = "ns.load_run()", "results/small/neuspring/0"
CODE = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with results as `make demo` leaves them, of a tiny rope."""
    here = tmp_path_factory.mktemp("api")
    scenario = played.results(here / "results")
    for method in ("baseline", "neuspring"):
        run = ns.load_run(scenario / method / "0")
        assert run.trajectory
        write_table(metrics.score(run.trajectory, run.observations, method, 0), run.folder / "scores.parquet")
    return here


def blocks(text):
    return CODE.findall(text.replace(PACKAGED, f'ns.load_run("{OWN}")'))


def of_notebook():
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    return "".join(f"```python\n{''.join(cell['source'])}\n```\n" for cell in cells if cell["cell_type"] == "code")


@pytest.mark.parametrize("text", [PAGE.read_text().partition("## Templates")[0], of_notebook()], ids=["page", "notebook"])
def test_every_block_runs(text, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    matplotlib.use("Agg")
    names = {}
    for block in blocks(text):
        exec(compile(block, "block", "exec"), names)
    run = names["run"]
    # Rolled out again, a twin moves as the workflow says.
    assert np.allclose(names["predicted"].positions, run.trajectory.positions)
    assert names["pulled"].positions.shape == (46, *run.trajectory.positions.shape[1:])
    assert names["pulled"].positions[-1, :, 2].max() > run.twin.topology.nodes[:, 2].max() + 0.02, "the hands lift it"
    assert len(names["scores"]) == sum(len(ns.load_run(f"results/small/{m}/0").scores) for m in ("baseline", "neuspring"))
    assert "e+0" not in capsys.readouterr().out, "numbers are for reading"


def test_a_summary_has_lengths_in_mm_and_four_digits(folder):
    run = ns.load_run(folder / OWN)
    vars(run)["scores"] = pd.concat([run.scores, run.scores.head(1).assign(metric="psnr", unit="dB", value=31.23456)])
    found, errors = run.summary(), run.scores.set_index(["metric", "task"])["value"]
    assert list(found.columns) == list(metrics.TASKS) and found.index[0] == (run.scores["metric"].iloc[0], "mm")
    for (metric, unit), row in found.iterrows():
        for task, value in row.dropna().items():
            assert value == pytest.approx((1e3 if unit == "mm" else 1) * errors[metric, task], rel=6e-4)
    assert found.loc[("psnr", "dB"), "reconstruction"] == 31.23 and np.isnan(found.loc[("psnr", "dB"), "future"])


def test_what_is_shown_is_in_the_cell_and_in_the_file(folder, tmp_path):
    run = ns.load_run(folder / OWN)
    assert run.trajectory and run.twin
    short = ns.Trajectory(positions=run.trajectory.positions[:3], frame_count=3)
    for what, name in ((run, "run.png"), (run.twin, "twin.svg"), (run.trajectory, "motion.png"), (short, "short.gif")):
        shown, kind = ns.show(what, output=tmp_path / name), name.rpartition(".")[2]
        assert (tmp_path / name).read_bytes() == shown.data
        assert f'<img src="data:image/{kind}' in shown._repr_html_()
    with Image.open(tmp_path / "short.gif") as film:
        alone = film.size
    with Image.open(io.BytesIO(ns.show(short, run.observations, film=True).data)) as film:
        assert film.format == "GIF" and film.size[0] > 1.5 * alone[0], "observed beside predicted"
    with pytest.raises(InputError, match=r"twin\.gif: a video needs a trajectory; received a twin"):
        ns.show(run.twin, output=tmp_path / "twin.gif")
    with pytest.raises(InputError, match=r"run\.doc: must end in one of \.png"):
        ns.show(run, output="run.doc")
    longer = ns.Trajectory(positions=np.repeat(run.trajectory.positions, 2, axis=0), frame_count=2 * len(run.trajectory.positions))
    with pytest.raises(InputError, match="Leave them out for other controllers"):
        ns.show(longer, run.observations, film=True)


def test_pictures_leave_a_notebooks_backend_alone():
    code = "import matplotlib; import neuspring.draw.sheet; print(matplotlib.get_backend())"
    for backend in ("module://matplotlib_inline.backend_inline", ""):
        environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
        environment |= {"MPLBACKEND": backend} if backend and importlib.util.find_spec("matplotlib_inline") else {}
        ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
        assert ("inline" if "MPLBACKEND" in environment else "agg") in ran.stdout.lower()


def test_a_checkpoint_of_another_fit_is_not_continued(folder, tmp_path, capsys):
    run, checkpoint = ns.load_run(folder / OWN), tmp_path / "fit.npz"
    soft = dataclasses.replace(
        run.twin, material=dataclasses.replace(run.twin.material, stiffness=0.5 * run.twin.material.stiffness)
    )

    def losses(twin, rate, epochs, **kept):
        return ns.fit(run.observations, twin, {"fit": {"epochs": epochs, "learning_rate": rate}}, **kept).history["loss"].tolist()

    first = losses(run.twin, 0.01, 1, checkpoint=checkpoint)
    for twin, rate in ((soft, 0.01), (run.twin, 0.05)):
        assert losses(twin, rate, 1, checkpoint=checkpoint) == losses(twin, rate, 1)
        assert "made with other inputs or settings; the fit starts over" in capsys.readouterr().out
    losses(run.twin, 0.01, 1, checkpoint=checkpoint)
    assert losses(run.twin, 0.01, 2, checkpoint=checkpoint)[0] == first[0]
    assert "resuming the fit after epoch 0" in capsys.readouterr().out


def test_a_mass_changes_forces_and_no_motion(folder):
    run = ns.load_run(folder / OWN)
    heavy = ns.with_mass(run.twin, 0.35)
    assert heavy.material.mass.sum() == pytest.approx(0.35, rel=1e-5)
    assert np.allclose(ns.roll_out(heavy, run.observations).positions, ns.roll_out(run.twin, run.observations).positions, atol=1e-5)
    fitted = ns.fit(run.observations, run.twin, {"fit": {"epochs": 1}}, kind="springs", mass=2.0)
    assert fitted.twin.material.mass.sum() == pytest.approx(2.0, rel=1e-5)
    for wrong in (0.0, -1.0, np.inf):
        with pytest.raises(InputError, match="mass: a positive number of kg"):
            ns.with_mass(run.twin, wrong)


def test_a_capture_becomes_a_run_with_its_twin(tmp_path):
    taken = film(tmp_path / "captures" / "ball", cameras=1)
    settings = replace(perceived.SETTINGS, search=Search(rollouts=8), fit=Fit(epochs=1))
    run = ns.twin_from_capture(taken.folder, settings, output=tmp_path / "results", mass=0.2, clusters=1, device="cpu")
    assert run.folder == tmp_path / "results" / "ball" / "python" / "0"
    assert set(run.stages) == {"search", "fit", "rollout"} and run.observations.scenario.name == "ball"
    assert run.twin and run.twin.material.mass.sum() == pytest.approx(0.2, rel=1e-5)
    assert {"chamfer", "track_error"} <= set(run.summary().index.get_level_values("metric"))
    # The same folder is one of the workflow's, which tables and commands read.
    assert json.loads((run.folder / "run.json").read_text())["scenario"] == "ball"
    with pytest.raises(InputError, match=r"capture\.json"):
        ns.twin_from_capture(tmp_path)


def test_the_name_alone_loads_nothing_heavy():
    code = "import sys, neuspring as ns; print(sorted({'torch', 'warp', 'pandas', 'numpy'} & set(sys.modules)), 'fit' in dir(ns))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "[] True"
    with pytest.raises(AttributeError, match="rollout"):
        ns.rollout  # noqa: B018
    assert all(getattr(ns, name) for name in ns.__all__)


def test_clear_errors(folder):
    run = ns.load_run(folder / OWN)
    count = len(run.twin.topology.controllers)
    with pytest.raises(InputError, match=rf"hands: must be observations, or positions \[T, {count}, 3\] in meters.*\(5, 3\)"):
        ns.roll_out(run.twin, np.zeros((5, 3)))
    with pytest.raises(InputError, match=r"must be the folder of a run.*results/<scenario>/<method>/<seed>"):
        ns.load_run(folder)
    with pytest.raises(InputError, match=r"fit\.epoch: unknown key"):
        ns.fit(run.observations, run.twin, {"fit": {"epoch": 3}})


def template(heading):
    return CODE.findall(PAGE.read_text().partition(heading)[2])[0]


def test_template_of_a_baseline(tmp_path, monkeypatch):
    (tmp_path / "mean_hand.py").write_text(template("**A baseline**"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(BASELINES._loaded, "mean_hand", Baseline(prediction="mean_hand:mean_hand"))
    seen = small.observations()
    predicted = BASELINES["mean_hand"].predict(seen, None, None, "cpu").trajectory
    hands = seen.controller_points.mean(axis=1)
    assert np.allclose(predicted.positions[-1] - predicted.positions[0], hands[-1] - hands[0], atol=1e-6)
    assert len(ns.score(predicted, seen))


def test_template_of_a_loss_term(tmp_path, monkeypatch):
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
    assert small.done(TwinFit(problem).epoch())["loss"] == pytest.approx(0.0, abs=1e-3)
