"""Correlation of a twin's stiffness with the true material of synthetic scenes.

    python -m results.published.stiffness.make RESULTS OUT [--methods ...] [--pictures SCENARIO ...]

An object of finite elements has a modulus per element (Young's modulus of a solid, membrane stiffness of a sheet); a twin has a
stiffness per spring. At each node, the geometric mean of the twin's springs is compared with the modulus of the nearest element
in frame 0. OUT/beside_truth.md contains the correlation of their logarithms, mean over seeds; OUT/beside_truth.csv a row per run.
OUT/SCENARIO.png shows both, relative to the geometric mean over nodes.
"""

from __future__ import annotations

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from neuspring.core.artifacts import Twin
from neuspring.core.files import write_text
from neuspring.core.run_folder import RunFolder
from neuspring.core.table import Table
from neuspring.draw.scene import ShownRun, ShownScene
from neuspring.draw.sheet import save
from neuspring.draw.twin import STIFFNESS_COLORS, TwinPicture
from neuspring.extensions.synthetic.truth import Truth, truth_path
from neuspring.twin.body import body_of

METHODS = ["search_only", "baseline_ten_frames", "model_b", "shuffled", "neuspring", "neuspring_plus", "baseline_plus"]
NOTE = "Correlation of log stiffness around each node with the log of the true modulus, mean over seeds."
LEAST_SPREAD = 1e-6
"""Standard deviation of logarithms below which values count as constant."""
LIMITS = (0.2, 5.0)
"""Range of colors: stiffness over its geometric mean."""


def modulus_at(truth: Truth, nodes: np.ndarray) -> np.ndarray:
    """Modulus [N] of the element whose center in frame 0 is nearest to each node: Pa, for sheets N/m."""
    solid = len(truth.tetrahedra) > 0
    elements, values = (truth.tetrahedra, truth.youngs_modulus) if solid else (truth.triangles, truth.membrane)
    return np.asarray(values[cKDTree(truth.nodes[0][elements].mean(axis=1)).query(nodes)[1]], dtype=float)


def made_of(twin: Twin, modulus: np.ndarray) -> Twin:
    """The twin's springs with the geometric mean of the modulus [N] at their two ends."""
    springs, inner = twin.topology.springs, twin.topology.object_spring_count
    stiffness = twin.material.stiffness.astype(float)
    stiffness[:inner] = np.sqrt(modulus[springs[:inner, 0]] * modulus[springs[:inner, 1]])
    return replace(twin, material=replace(twin.material, stiffness=stiffness.astype(np.float32)))


def relative(twin: Twin) -> Twin:
    """The twin with its stiffness over the geometric mean of its nodes' stiffness."""
    stiffness = twin.material.stiffness / np.exp(np.log(body_of(twin).node_stiffness(twin)).mean())
    return replace(twin, material=replace(twin.material, stiffness=stiffness.astype(np.float32)))


def picture(scenario: str, takes: Sequence[ShownRun], scene: ShownScene) -> Figure:
    """Figure of the truth and the twins, four per row."""
    rows, height = -(-len(takes) // 4), 4 * scene.view.height / scene.view.width
    figure, axes = plt.subplots(rows, 4, figsize=(16, rows * (height + 0.3) + 0.9), layout="constrained", squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, take in zip(axes.flat, takes, strict=False):
        TwinPicture([(scene, take)], 0, ("stiffness",), limits=LIMITS).paint(axis, scene, take, "stiffness")
        axis.set_title(take.label, fontsize=9)
    label = "stiffness / its geometric mean"
    bar = figure.colorbar(
        ScalarMappable(LogNorm(*LIMITS), STIFFNESS_COLORS),
        ax=axes,
        label=label,
        location="bottom",
        aspect=60,
        shrink=0.5,
        ticks=[0.2, 0.5, 1, 2, 5],
        format="{x:g}",
    )
    bar.ax.tick_params(labelsize=8)
    bar.ax.minorticks_off()
    figure.suptitle(scenario, fontsize=10)
    return figure


def judged(home: Path, methods: Sequence[str]) -> tuple[list[tuple[str, int, float]], list[ShownRun], ShownScene | None]:
    """(method, seed, correlation) of the runs of a scenario; the truth and one twin per method; the scene for the figure."""
    truth, rows, takes, scene = Truth.load(truth_path(home / "capture")), [], dict[str, ShownRun](), None
    for path in (path for method in methods for path in sorted(home.glob(f"{method}/*/rollout.json"))):
        run = RunFolder.of(path.parent)
        if (twin := run.twin) is None:
            continue
        method, seed = run.folder.parts[-2:]
        modulus, here = modulus_at(truth, twin.topology.nodes), twin.topology.nodes[None]
        logs = np.log([modulus, body_of(twin).node_stiffness(twin)])
        known = (logs.std(axis=1) > LEAST_SPREAD).all()
        rows.append((method, int(seed), float(np.corrcoef(logs)[0, 1]) if known else np.nan))
        takes.setdefault("truth", ShownRun("truth", here, relative(made_of(twin, modulus))))
        takes.setdefault(method, ShownRun(method, here, relative(twin)))
        scene = scene or ShownScene.from_side(run.observations, list(takes.values()), [0])
    return rows, list(takes.values()), scene


def main() -> None:
    """Write the table, and a figure of each scene of --pictures."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--pictures", nargs="*", default=[], metavar="SCENARIO")
    options = parser.parse_args()
    rows = []
    for folder in sorted(options.results.glob("*/capture_truth.npz")):
        name = folder.parent.name.removeprefix("synthetic_")
        found, takes, scene = judged(folder.parent, options.methods)
        rows += [(name, *row) for row in found]
        if scene and folder.parent.name in options.pictures:
            save(picture(name, takes, scene), options.output / f"{name}.png")
    table = pd.DataFrame(rows, columns=["scenario", "method", "seed", "correlation"]).dropna()
    write_text(options.output / "beside_truth.csv", table.to_csv(index=False, float_format="%.4f"))
    wide = table.pivot_table(index="scenario", columns="method", values="correlation")
    wide = wide[[method for method in options.methods if method in wide]]
    wide.loc["mean over scenes"] = wide.mean()
    cells = [[str(name), *(f"{r:.2f}" for r in row)] for name, row in wide.iterrows()]
    lines = Table.of_texts(["scene", *wide.columns], cells).markdown()
    write_text(options.output / "beside_truth.md", "\n".join(["# Stiffness and truth", "", NOTE, "", *lines, ""]))


if __name__ == "__main__":
    main()
