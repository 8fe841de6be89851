r"""The cost of one color camera on synthetic scenes with known truth: three RGBD cameras, one RGBD camera, one color camera.

    python -m results.published.one_color_camera.make make CAPTURES OUT       # captures of one camera, with and without depth
    python -m results.published.one_color_camera.make table OUT RESULTS --output TABLES

CAPTURES is a folder of results of config/data/synthetic.yaml (`--until perceive` is enough) with <scenario>/capture and its
truth. The six published scenes are synthetic_double_lift_cloth_1, synthetic_single_lift_cloth_4, synthetic_double_lift_sloth,
synthetic_single_lift_zebra, synthetic_single_lift_rope and synthetic_single_push_rope_4. OUT gets SCENE_three (a link to the
capture), SCENE_one and SCENE_color for each scene, and scenarios.tsv, for a run with

    --configfile config/data/color.yaml config/studies/one_color_camera.yaml \
    --config data_root=OUT scenario_table=OUT/scenarios.tsv scenarios="[$(tail -n +2 OUT/scenarios.tsv | cut -f1 | paste -sd,)]"

TABLES/errors.csv contains every error, TABLES/summary.md the means: controllers against the truth, the shape in frame 0 against the
true surface, and track errors of predictions in 3D.
"""

from __future__ import annotations

import shutil
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from neuspring.core.artifacts import Observations
from neuspring.core.table import Table
from neuspring.data.capture import Capture, Writer
from neuspring.extensions.synthetic.truth import Truth, truth_of
from neuspring.scenes.sources import read_scenarios

ARMS = ("three", "one", "color")
"""Three RGBD cameras, only the first of them, and only its color."""
MM = 1e3


def make(results: Path, out: Path) -> None:
    """Write captures of all arms, and the table of scenarios."""
    rows = ["scenario\tsource\tcategory\tpath\tself_collision\tground"]
    known = read_scenarios(Path("config/scenarios.tsv"))
    out.mkdir(parents=True, exist_ok=True)
    for folder in sorted(path.parent for path in results.glob("*/capture/capture.json")):
        capture, scene = Capture.load(folder), folder.parent.name
        for arm in ARMS:
            target = out / f"{scene}_{arm}"
            if arm == "three":
                if not target.exists():
                    target.symlink_to(folder.resolve())
            elif not (target / "capture.json").exists():
                one_camera(capture, target, depth=arm == "one")
            collides = str(known[scene].self_collision).lower()
            rows.append(f"{target.name}\tcapture\t{capture.description.category}\t{target.name}\t{collides}\ttrue")
        print(scene, flush=True)
    (out / "scenarios.tsv").write_text("\n".join(rows) + "\n")


def one_camera(capture: Capture, target: Path, *, depth: bool) -> Capture:
    """Write a copy of a capture with only its first camera."""
    name = next(iter(capture.cameras))
    description = replace(
        capture.description, name=target.name, cameras=capture.description.cameras[:1], depth="measured" if depth else "none"
    )
    writer = Writer(target, description)
    for kind in ("color", "mask", *(["depth"] if depth else [])):
        shutil.copytree(capture.folder / kind / name, target / kind / name, dirs_exist_ok=True)
    return writer.finish(capture.tracks())


def hand_errors(truth: Truth, seen: Observations) -> tuple[float, float]:
    """Mean error, m, of the motion of hands: over all frames, and in the last frame.

    A hand's position is the mean of its controllers. Its displacement from frame 0 is compared with that of the true hand.
    """
    poses, hands = truth.hand_poses[..., :3].astype(float), seen.controller_points.astype(float)
    nearest = cKDTree(poses[0]).query(hands[0])[1]
    errors = []
    for hand in range(poses.shape[1]):
        own = hands[:, nearest == hand]
        if own.shape[1]:
            errors.append(np.linalg.norm((own.mean(axis=1) - own[0].mean(axis=0)) - (poses[:, hand] - poses[0, hand]), axis=1))
    mean = np.mean(errors, axis=0)
    return float(mean[1:].mean()), float(mean[-1])


def shape_errors(truth: Truth, seen: Observations) -> tuple[float, float]:
    """Mean distance, m, in frame 0: of surface nodes from the true surface, and of the true surface from nodes."""
    surface, nodes = truth.surface(0), seen.nodes[: seen.surface_count]
    return float(cKDTree(surface).query(nodes)[0].mean()), float(cKDTree(nodes).query(surface)[0].mean())


def collect(captures: Path, results: Path) -> pd.DataFrame:
    """All errors; columns scene, arm, method, seed, metric, value_mm."""
    rows: list[tuple[str, str, str, int, str, float]] = []
    for path in sorted(captures.glob("*_three")):
        scene, truth = path.name.removesuffix("_three"), truth_of(Capture.load(path.resolve()))
        for arm in ARMS:
            folder = results / f"{scene}_{arm}"
            if not (folder / "observations.npz").exists():
                continue
            seen = Observations.load(folder / "observations.npz")
            away, covered = shape_errors(truth, seen)
            rows += [(scene, arm, "", 0, "surface nodes from the true surface", MM * away)]
            rows += [(scene, arm, "", 0, "true surface from nodes", MM * covered)]
            for name, error in zip(("mean", "last"), hand_errors(truth, seen), strict=True):
                rows += [(scene, arm, "", 0, f"hands, {name}", MM * error)]
            for file in sorted(folder.glob("*/*/scores.parquet")):
                method, seed = file.parts[-3], int(file.parts[-2])
                for score in pd.read_parquet(file).itertuples():
                    if score.metric in ("track_error", "chamfer"):
                        rows.append((scene, arm, method, seed, f"{score.metric}, {score.task}", MM * float(score.value)))
    return pd.DataFrame(rows, columns=["scene", "arm", "method", "seed", "metric", "value_mm"])


def summary(errors: pd.DataFrame) -> str:
    """Mean over scenes of every metric by method and arm, in Markdown."""
    means = errors.groupby(["metric", "method", "arm"])["value_mm"].mean().unstack("arm").reindex(columns=list(ARMS))
    rows = [
        [str(metric), str(method), *("–" if np.isnan(value) else f"{value:.1f}" for value in row)]
        for (metric, method), row in zip(means.index, means.to_numpy(), strict=True)
    ]
    scenes = errors["scene"].nunique()
    lines = Table.of_texts(["mean over scenes, mm", "method", "three RGBD", "one RGBD", "one color"], rows).markdown()
    return "\n".join([f"{scenes} scenes.", "", *lines]) + "\n"


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    making, tabling = commands.add_parser("make"), commands.add_parser("table")
    making.add_argument("results", type=Path)
    making.add_argument("out", type=Path)
    tabling.add_argument("captures", type=Path)
    tabling.add_argument("results", type=Path)
    tabling.add_argument("--output", type=Path, required=True)
    a = parser.parse_args()
    if a.command == "make":
        make(a.results, a.out)
        return
    errors = collect(a.captures, a.results)
    a.output.mkdir(parents=True, exist_ok=True)
    errors.to_csv(a.output / "errors.csv", index=False, float_format="%.4g")
    text = summary(errors)
    (a.output / "summary.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
