"""The foam cylinder of PRB-Net (arXiv 2307.07975): errors of our twins and of the published rivals on the test trajectory.

    python -m results.published.foam.make DATA RESULTS --output OUT [--methods rod_slip ...] [--trajectory 8]

DATA contains traj{1..8}.csv and rivals/; RESULTS is the folder of `config/data/foam.yaml`. OUT/summary.md contains the table,
OUT/errors.csv a row per model and window, OUT/ways.png paths and errors over time. Errors are distances of the end marker at 250
Hz. A twin is rolled out once from rest in sample 0 with the motion of the base, and its path is cut into windows. Rivals restart
each window.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline

from neuspring.config import Config, ScenarioRow
from neuspring.config.parse import parse, read_yaml
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.files import write_text
from neuspring.core.run_folder import RunFolder
from neuspring.core.table import Table
from neuspring.draw.sheet import save
from neuspring.extensions.rods import posed
from neuspring.report.blocks import markdown
from neuspring.twin.body import body_of
from neuspring.twin.rollout import roll_out
from neuspring.twin.transfer import move

CM, RATE = 100.0, 250
WINDOW = 5001
"""Samples of 20 s."""
WINDOWS = {251: "1 s", 501: "2 s", 1251: "5 s", 2501: "10 s", WINDOW: "20 s"}
RIVALS = {
    "rnn_LFK": "PRB-Net: RNN, physics decoder",
    "rnn_NN": "RNN, network decoder",
    "resnet_LFK": "ResNet, physics decoder",
    "resnet_NN": "ResNet, network decoder",
    "rfem": "rigid finite elements, first principles",
}
STAYS = "the end stays where it was"
NOTE = """\
Mean distance of the end marker, cm, at 250 Hz on trajectory {trajectory}, which begins at rest. **Only in the window of 20 s
twins and rivals get the same input**: the motion of the base, and rest in the first sample. In shorter windows rivals get
position and velocity of the end at the start of each window, and nothing before it. Twins are rolled out once from rest and get
the motion of the base only. Errors of rivals are computed from their published predictions by the code that scores ours."""
END = 1
"""Index of the end marker among the tracked points."""


def errors_of(truth: np.ndarray, predicted: np.ndarray, window: int) -> dict[str, float]:
    """Mean, root mean square and largest distance, cm, of predictions [n, 3], m, in complete windows."""
    count = len(truth) // window * window
    apart = CM * np.linalg.norm(truth[:count] - predicted[:count], axis=1)
    return {"windows": count // window, "mean": apart.mean(), "rms": np.sqrt((apart**2).mean()), "largest": apart.max()}


def rival(folder: Path, name: str, window: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Truth and prediction of the end [n, 3], m, in consecutive windows; None without a file."""
    path = folder / "rivals" / f"{name}_predictions_{window}steps.csv"
    if not path.exists():
        return None
    table = pd.read_csv(path)
    seen, predicted = (table[[f"{kind}_{axis}" for axis in "xyz"]].to_numpy() for kind in ("pe", "hat_pe"))
    return seen, predicted


def observed(folder: Path, trajectory: int, settings: Config, stride: int = 1) -> Observations:
    """Observations of a trajectory of the data."""
    name = f"foam_{trajectory}"
    row = ScenarioRow(scenario=name, source="posed", category="foam", path="", self_collision=False, ground=False)
    own = replace(settings, posed=replace(settings.posed, stride=stride))
    return posed.observe(row, folder / f"traj{trajectory}.csv", own, folder / name)


def predicted_path(twin: Twin, folder: Path, trajectory: int, settings: Config) -> np.ndarray:
    """Predicted positions of the end [n, 3], m, at 250 Hz, interpolated from the frame rate of the fit."""
    stride = round(RATE * twin.simulation.frame_time)
    here = observed(folder, trajectory, settings, stride)
    body = body_of(twin)
    moved = body.for_prediction(move(twin, here))
    positions = roll_out(moved, here.controller_points).positions[:, END].astype(np.float64)
    last = stride * (len(positions) - 1)
    return np.asarray(CubicSpline(np.arange(0, last + 1, stride), positions)(np.arange(last + 1)))


def scored(folder: Path, paths: Mapping[str, np.ndarray], truth: np.ndarray, trajectory: int) -> pd.DataFrame:
    """Mean, rms and largest error, cm; one row per model and window."""
    rows = []
    for window in WINDOWS:
        found = {RIVALS[name]: rival(folder, name, window) for name in RIVALS} if trajectory == 8 else {}
        found |= {name: (truth, path) for name, path in paths.items()}
        first = np.arange(len(truth)) // window * window
        found[STAYS] = (truth, truth[first])
        rows += [{"model": name, "window": window} | errors_of(*pair, window) for name, pair in found.items() if pair]
    return pd.DataFrame(rows)


def drawn(truth: np.ndarray, pairs: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Observed and predicted paths of the end (pairs of [n, 3], m) by coordinate, and errors below."""
    figure, (*panels, errors) = plt.subplots(4, 1, figsize=(9, 8), sharex=True, layout="constrained")
    panels[0].set_title("gray: observed", fontsize=9, loc="left")
    time = np.arange(WINDOW) / RATE
    for k, panel in enumerate(panels):
        panel.plot(time, truth[:WINDOW, k], color="0.75", lw=4)
        panel.set_ylabel(f"end, {'xyz'[k]} [m]")
    for name, (seen, predicted) in pairs.items():
        apart = CM * np.linalg.norm(seen[:WINDOW] - predicted[:WINDOW], axis=1)
        [line] = errors.plot(time, apart, lw=1.2, label=f"{name}: {apart.mean():.2f} cm")
        for k, panel in enumerate(panels):
            panel.plot(time, predicted[:WINDOW, k], color=line.get_color(), lw=1.0)
    errors.set(xlabel="time from rest [s]", ylabel="error of the end [cm]", ylim=(0, 25), xlim=(0, 20))
    errors.legend(fontsize=8, framealpha=0.9)
    return figure


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--methods", nargs="+", default=["rod_knots", "rod_slip"])
    parser.add_argument("--trajectory", type=int, default=8, help="4: validation, 8: test")
    parser.add_argument("--settings", type=Path, default=Path("config/data/foam.yaml"))
    a = parser.parse_args()
    settings = parse(Config, read_yaml(a.settings), str(a.settings))
    truth = observed(a.data, a.trajectory, settings).object_points[:, END].astype(np.float64)
    paths = {}
    for method in a.methods:
        run = RunFolder.of(a.results / settings.scenarios[0] / method / "0")
        twin = Twin.load(run.file(run.learning[-1], "twin"))
        paths[method] = predicted_path(twin, a.data, a.trajectory, settings)
    table = scored(a.data, paths, truth, a.trajectory)
    a.output.mkdir(parents=True, exist_ok=True)
    write_text(a.output / "errors.csv", table.to_csv(index=False, float_format="%.4f"))
    heads = ["model", *WINDOWS.values(), "20 s: rms", "largest"]
    rows = []
    for name, part in table.groupby("model", sort=False):
        own = part.set_index("window")
        cells = [f"{own['mean'][window]:.2f}" if window in own.index else "" for window in WINDOWS]
        rows.append([str(name), *cells, *(f"{own[key][WINDOW]:.2f}" for key in ("rms", "largest"))])
    note = NOTE.format(trajectory=a.trajectory)
    write_text(
        a.output / "summary.md", "# The foam cylinder\n\n" + note + "\n\n" + markdown([Table.of_texts(heads, rows, "")]) + "\n"
    )
    pairs = {name: (truth, path) for name, path in paths.items()}
    if a.trajectory == 8:
        pairs |= {RIVALS[name]: rival(a.data, name, WINDOW) for name in ("rnn_LFK", "resnet_LFK", "rfem")}
    save(drawn(truth, pairs), a.output / "ways.png")
    print(a.output / "summary.md")


if __name__ == "__main__":
    main()
