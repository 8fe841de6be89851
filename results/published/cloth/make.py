"""A square cloth that a robot holds at two corners (recordings of Alados5/tfm_matlab, ea4056c): captures and errors.

    python -m results.published.cloth.make captures MATS CAPTURES [--corners]
    python -m results.published.cloth.make tables MATS OUT --results RESULTS [...]

MATS contains SOMtraj*_10ms.mat of the folder `Processed MAT S7`. `captures` keeps every fourth sample (25 Hz; the authors
smoothed about 9.6 images per second) and rotates each recording so that the cloth hangs straight below its corners in frame 0.
Controllers are the points of the upper edge. They keep their offset in frame 0 from the line between the corners and move with
that line. The recorded edge deviates from this by 3 to 5 mm, a row of springs by 2 to 10 mm. With `--corners` only the corners
are controllers. All other nodes are annotated. `tables` writes scores.csv, with a row per run and recording, and summary.md.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from neuspring.core.files import write_text
from neuspring.core.geometry import lean
from neuspring.core.table import Table
from neuspring.data.capture import Description, Writer
from neuspring.intake.points import Hands, write
from neuspring.report.blocks import markdown

STRIDE, RATE = 4, 25.0
RIVAL = 4
"""Nodes along an edge of the rival's model; a recording's mesh has 3 k + 1."""
MEAN = -1
"""Stands for a seed: the mean prediction of all seeds."""
NOTE = """\
Mean distance, mm, of predicted and recorded nodes over all frames, open loop, on the rival's 4 x 4 nodes. The two held corners are
given and count as 0. ±: standard deviation over seeds; after the semicolon, the error of their mean prediction."""


def read(path: Path) -> np.ndarray:
    """Nodes [T, n, n, 3], m, of a recording at 25 Hz, rotated to hang straight; row 0 is the lowest."""
    states = np.asarray(loadmat(path, simplify_cells=True)["SOMrec"]["states"], float)
    mesh = states[: len(states) // 2].reshape(3, -1, states.shape[1]).transpose(2, 1, 0)[::STRIDE]
    side = round(mesh.shape[1] ** 0.5)
    corners = mesh[0, [-side, -1]]
    free = np.delete(mesh[0], [len(mesh[0]) - side, len(mesh[0]) - 1], axis=0)
    turn = Rotation.from_rotvec(lean(free, corners, 1.0)).as_matrix()
    return np.asarray(mesh @ turn.T).reshape(len(mesh), side, side, 3)


def edge(mesh: np.ndarray) -> np.ndarray:
    """Upper edge [T, n, 3], m, from frame 0 and the two corners."""
    along = np.linspace(0, 1, mesh.shape[1])[:, None]
    line = mesh[:, -1, :1] * (1 - along) + mesh[:, -1, -1:] * along
    return np.asarray(line + (mesh[0, -1] - line[0]))


def error(mesh: np.ndarray, positions: np.ndarray) -> float:
    """Mean distance, mm, on the rival's nodes; positions [T, N, 3], m: nodes below the upper edge, or all but the corners."""
    frames, side = mesh.shape[:2]
    predicted = mesh.copy()
    predicted[:, -1] = edge(mesh)
    below = side * (side - 1)
    predicted[:, :-1] = positions[:, :below].reshape(frames, side - 1, side, 3)
    predicted[:, -1, 1 : 1 + positions.shape[1] - below] = positions[:, below:]
    step = (side - 1) // (RIVAL - 1)
    return float(1e3 * np.linalg.norm(mesh - predicted, axis=3)[:, ::step, ::step].mean())


def capture(path: Path, output: Path, corners: bool) -> str:
    """Write the capture OUTPUT/cloth_TRAJECTORY_TRIAL of a recording; return its name."""
    mesh, name = read(path), path.stem.removesuffix("_10ms").replace("SOMtraj", "cloth_")
    described = Description(
        format=1,
        name=name,
        category="cloth",
        frame_count=len(mesh),
        frame_rate=RATE,
        cameras=(),
        depth="none",
        tracks="train",
        train_end=len(mesh),
        self_collision=False,
        ground=False,
    )
    held = edge(mesh)[:, [0, -1]] if corners else edge(mesh)
    nodes = mesh[:, :-1].reshape(len(mesh), -1, 3)
    nodes = np.concatenate([nodes, mesh[:, -1, 1:-1]], axis=1) if corners else nodes
    writer = Writer(output / name, described)
    write(output / name, Hands(held, np.zeros((0, 0), bool), np.zeros(0, int)), nodes[0])
    writer.finish(nodes)
    return name


def scores(mats: Path, results: Sequence[Path]) -> pd.DataFrame:
    """Error in mm, one row per folder of results, method, seed and recording."""
    found: dict[tuple[str, str, str], dict[int, np.ndarray]] = {}
    for path in (path for folder in results for path in sorted(folder.glob("*/*/*/transfer_positions.npz"))):
        for target, positions in ((name, array) for name, array in np.load(path).items() if name.startswith("cloth_")):
            found.setdefault((path.parts[-5], path.parts[-3], target), {})[int(path.parts[-2])] = positions
    rows = []
    for (folder, method, target), runs in found.items():
        mesh = read(mats / f"{target.replace('cloth_', 'SOMtraj')}_10ms.mat")
        runs[MEAN] = np.mean(list(runs.values()), axis=0)
        rows += [(folder, method, seed, target, error(mesh, positions)) for seed, positions in runs.items()]
    return pd.DataFrame(rows, columns=["results", "method", "seed", "recording", "error"])


def table(scored: pd.DataFrame) -> Table:
    """Table with a row per folder of results and method, and a column per recording."""
    targets = sorted(scored["recording"].unique())
    rows = []
    for names, part in scored.groupby(["results", "method"], sort=False):
        cells = []
        for target in targets:
            own = part[part["recording"] == target].set_index("seed")["error"]
            seeds = own.drop(MEAN, errors="ignore")
            cells.append(
                f"{seeds.mean():.1f} ± {seeds.std(ddof=1):.1f}; {own[MEAN]:.1f}"
                if len(seeds) > 1
                else " ".join(f"{one:.1f}" for one in seeds)
            )
        rows.append([*names, *cells])
    return Table.of_texts(["results", "method", *targets], rows)


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=("captures", "tables"))
    parser.add_argument("mats", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--corners", action="store_true", help="only the corners are controllers")
    parser.add_argument("--results", type=Path, nargs="+", default=[Path("results/cloth")])
    a = parser.parse_args()
    if a.task == "captures":
        for path in sorted(a.mats.glob("SOMtraj*_10ms.mat")):
            print(capture(path, a.output, a.corners))
        return
    scored = scores(a.mats, a.results)
    a.output.mkdir(parents=True, exist_ok=True)
    write_text(a.output / "scores.csv", scored.to_csv(index=False, float_format="%.2f"))
    write_text(a.output / "summary.md", f"# A real cloth held at two corners\n\n{NOTE}\n\n{markdown([table(scored)])}\n")


if __name__ == "__main__":
    main()
