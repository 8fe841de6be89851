"""What each part brings where there is color alone: hand depth searched or fixed, silhouettes, tracks, coverage.

    python -m tests.benchmarks.footage_parts RESULTS --output OUT

RESULTS is the folder of a run with config/data/color.yaml, config/studies/footage.yaml and footage_parts.yaml. The table
judges training frames: silhouettes' IoU, and the distance in the image between tracked points and their nodes. Future IoU stands
beside it, for the reader; nothing was chosen by it. OUT/parts.csv has every run, OUT/parts.md the table.
"""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path

import numpy as np
import pandas as pd

from neuspring.config import Config, parse, read_yaml
from neuspring.core.artifacts import Observations, Trajectory
from neuspring.core.run_record import RunRecord
from neuspring.core.text import markdown
from neuspring.data.capture import Camera
from tests.benchmarks.beside_tables import DASH, differences

STUDY = Path(__file__).parents[2] / "config" / "studies" / "footage_parts.yaml"
WHOLE = "search_only"
"""The row that others are compared with."""
COLUMNS = {"iou": "IoU, training frames", "points": "tracked points, px, median", "future": "IoU, future frames"}


def track_errors(observations: Observations, positions: np.ndarray) -> np.ndarray:
    """Distance, px, of each tracked point from its node in the image, of all that are seen in training frames after frame 0."""
    image = observations.image
    assert image is not None, "color alone"
    camera = Camera("0", image.width, image.height, image.intrinsics, image.camera_to_world)
    end = min(observations.scenario.train_end, len(positions))
    found = camera.project(positions[1:end, : image.pixels.shape[1]].astype(float))[0]
    return np.asarray(np.linalg.norm(found - image.pixels[1:end], axis=2)[image.visible[1:end]])


def read_run(results: Path, scenario: str, method: str, seed: str) -> dict[str, object] | None:
    """A row of the table of runs; None if the run is not there."""
    folder = results / scenario / method / seed
    if not (folder / "run.json").exists():
        return None
    status = RunRecord.load(folder / "run.json").status
    row: dict[str, object] = {"scenario": scenario, "method": method, "seed": int(seed), "status": status}
    scores = pd.read_parquet(folder / "scores.parquet")
    ious = scores[scores["metric"] == "iou"].set_index("task")["value"]
    row |= {"iou": ious.get("reconstruction", np.nan), "future": ious.get("future", np.nan)}
    if (folder / "trajectory.npz").exists():
        observations = Observations.load(results / scenario / "observations.npz")
        errors = track_errors(observations, Trajectory.load(folder / "trajectory.npz").positions)
        row["points"] = float(np.median(errors))
    return row


def summary(runs: pd.DataFrame) -> str:
    """Markdown: means over scenarios, and over seeds within them; ± is the standard deviation over seeds.

    The last column is the training frames' IoU less that of WHOLE, paired by scenario, with its 95 % t interval over scenarios.
    """
    compared = runs.rename(columns={"scenario": "case", "iou": "value"})
    rows = []
    for method, own in runs.groupby("method", sort=False):
        cells = [str(method), str(own["scenario"].nunique())]
        for column in COLUMNS:
            by_seed = own.groupby("seed")[column].mean()
            digits = 1 if column == "points" else 3
            spread = f" ± {by_seed.std(ddof=1):.{digits}f}" if len(by_seed) > 1 else ""
            cells.append(f"{own.groupby('scenario')[column].mean().mean():.{digits}f}{spread}")
        found = differences(compared, str(method), WHOLE) if method != WHOLE else None
        cells.append("{:+.3f} [{:+.3f}, {:+.3f}]".format(*found) if found and found[-1] > 1 else DASH)
        rows.append(cells)
    return "\n".join(markdown(["row", "scenes", *COLUMNS.values(), f"IoU, training frames, less {WHOLE}"], rows)) + "\n"


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    a = parser.parse_args()
    study = parse(Config, read_yaml(STUDY), str(STUDY))
    found = []
    for method in study.methods:
        for scenario in study.scenarios:
            seeds = sorted(path.name for path in (a.results / scenario / method).glob("*") if path.name.isdigit())
            found += [row for seed in seeds if (row := read_run(a.results, scenario, method, seed))]
    runs = pd.DataFrame(found)
    a.output.mkdir(parents=True, exist_ok=True)
    runs.to_csv(a.output / "parts.csv", index=False, float_format="%.5g")
    text = summary(runs)
    (a.output / "parts.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
