"""All 22 scenes of the paper from video: silhouettes of twins from one color camera and of renders of PhysTwin and Boba.

    python -m results.published.film22.make DATA WORK [--cores 2] [--only TEXT] [--output OUT] [--strips FOLDER]

DATA contains phystwin22_films and phystwin_camera0. WORK gets captures and the results of config/data/film22.yaml; rerun the same
command to resume. --only selects runs like the key `only`; --cores 0 runs nothing. OUT gets summary.md with the tables,
scores.csv with all numbers, and silhouettes.npz with the predictions of the method `BEST`, which was declared before the run.
Scenes that WORK does not contain stay in OUT. With z = np.load("silhouettes.npz") the object in frame z["CASE_frames"][k] of a
seed is

    np.unpackbits(z["CASE"][seed, k]).reshape(362, 640)

A rival's silhouette is the difference of its pane from the empty table, moved by one shift per rival and scene, fitted in frame 0.
All methods are scored on the frames that the rivals show. --strips writes images of the observation, the rivals and `BEST` for
inspection; do not commit them.
"""

from __future__ import annotations

import functools
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from scipy import ndimage

from neuspring.config.images import Images
from neuspring.config.parse import parse, read_yaml
from neuspring.core.errors import NumericalFailure
from neuspring.core.files import write_text
from neuspring.core.job_records import read_jobs
from neuspring.core.run_folder import RunFolder
from neuspring.core.run_record import RUN_RECORD, RunRecord
from neuspring.core.table import Table
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.draw.sheet import FUTURE, TRAINING
from neuspring.scores.pictures import Scored, iou
from neuspring.scores.statistics import t_interval
from neuspring.splats.draw import picture
from neuspring.stages.render import posed
from results.published.film22.films import NAME, PREFIX, cases_of, film, pane, write_captures

ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "config" / "data" / "film22.yaml"
BEST = "model_b_wide_mean"
"""Declared as the main method before this version ran."""
RIVALS = {"PhysTwin": 1, "Boba": 2}
"""Rival -> its pane, of three, in renders_25fps."""
NEW = ("double_lift_cloth_3", "double_stretch_sloth", "double_stretch_zebra", "rope_double_hand", "single_clift_cloth_1")
NEW += ("single_lift_cloth", "single_lift_dinosor", "single_push_rope_1", "single_push_sloth", "weird_package")
"""Scenes that were new when commit 93abeb55 ran them with frozen settings."""
DIFFERENT, COLORED, LEAST_PART = 20.0, 9.0, 0.03
"""Least changes of a pixel of the object, gray levels; least fraction of the silhouette of a component."""
MOST, STEP = 6.0, 0.5
"""Largest shift and its step, px."""
SHOWN = 9
"""Intervals between the frames of silhouettes.npz; they include the thirds of the video."""
TASKS = ("training", "future")
COLUMNS = ["case", "method", "seed", "masks", "part", "value"]


def silhouette(render: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Object mask [H, W] bool of a render [H, W, 3] against the empty table [H, W, 3], with filled holes."""
    change = render.astype(np.float32) - table
    mean = change.mean(axis=2)
    found = (np.abs(mean) > DIFFERENT) | (np.abs(change - mean[..., None]).max(axis=2) > COLORED)
    # Not by OpenCV: its opening with an even square shifts the mask by a pixel.
    found = ndimage.binary_closing(ndimage.binary_opening(found, np.ones((2, 2))), np.ones((3, 3)))
    parts, _ = ndimage.label(found, np.ones((3, 3)))
    areas = np.bincount(parts.ravel())
    areas[0] = 0
    return np.asarray(ndimage.binary_fill_holes((areas >= max(LEAST_PART * areas.sum(), 1))[parts]))


def shifted(mask: np.ndarray, shift: tuple[float, float]) -> np.ndarray:
    """A silhouette [H, W] bool moved by (x, y), px; pixels that are covered by more than half stay."""
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    return np.asarray(cv2.warpAffine(mask.astype(np.float32), matrix, mask.shape[::-1], flags=cv2.INTER_LINEAR) > 0.5)


def fitted_shift(mask: np.ndarray, labels: np.ndarray) -> tuple[float, float]:
    """Shift (x, y), px, of a silhouette [H, W] bool with the best IoU with the object in labels [H, W]."""
    tried = np.arange(-MOST, MOST + STEP / 2, STEP)
    # Prefer the smallest among equally good shifts.
    ordered = sorted(((float(x), float(y)) for x in tried for y in tried), key=lambda s: (abs(s[0]) + abs(s[1]), s))
    return max(ordered, key=lambda shift: iou_without_hands(shifted(mask, shift), labels))


def iou_without_hands(mask: np.ndarray, labels: np.ndarray) -> float:
    """IoU of a silhouette [H, W] bool with the object in labels [H, W]; pixels of hands are ignored on both sides."""
    return iou(mask & (labels != HANDS), labels == OBJECT)


@dataclass(frozen=True, eq=False)
class Scene:
    """A case: its video, its capture and the folder of its runs."""

    name: str
    data: Path
    capture: Capture
    runs: Path

    @functools.cached_property
    def pairs(self) -> list[int]:
        """Frame of the video for each frame of the renders."""
        table = pd.read_csv(self.data / "phystwin22_films" / "frame_map.csv", index_col=0)
        return [int(frame) for frame in table.loc[self.name].iloc[-1].split()]

    @property
    def count(self) -> int:
        return self.capture.frame_count

    @property
    def kept(self) -> list[int]:
        """Frames of silhouettes.npz, including the first and the last."""
        return sorted({k * (self.count - 1) // SHOWN for k in range(SHOWN + 1)})

    @functools.cached_property
    def drawn(self) -> dict[int, np.ndarray]:
        """Labels [H, W] that were drawn manually after frame 0, at the size of the video; empty for most cases."""
        files = sorted((self.data / "phystwin_camera0" / "masks" / self.name).glob("*.png"))[1:]
        size = self.labels(0).shape[::-1]
        return {int(f.stem): cv2.resize(cv2.imread(str(f), 0), size, interpolation=cv2.INTER_NEAREST) for f in files}

    def labels(self, frame: int) -> np.ndarray:
        """Labels [H, W] of the capture, propagated from the annotations of frame 0."""
        return self.capture.mask(NAME, frame)

    def renders(self, rival: str) -> list[np.ndarray]:
        """A rival's images."""
        return pane(self.data / "phystwin22_films" / "renders_25fps" / f"{self.name}.mp4", RIVALS[rival], 1 + len(RIVALS))

    def rival(self, rival: str) -> tuple[list[np.ndarray], tuple[float, float]]:
        """A rival's shifted silhouettes [H, W] bool of the frames `pairs`, and the shift."""
        table = cv2.imread(str(self.data / "phystwin22_films" / "empty_table.png"))[..., ::-1].astype(np.float32)
        masks = [silhouette(render, table) for render in self.renders(rival)]
        shift = fitted_shift(masks[0], self.labels(0))
        return [shifted(mask, shift) for mask in masks], shift

    def means(self, values: Mapping[int, float]) -> dict[str, float]:
        """Mean of values by frame for each task; frame 0 belongs to no task."""
        parts = zip(TASKS, (range(1, self.capture.train_end), range(self.capture.train_end, self.count)), strict=True)
        return {task: float(np.mean([values[k] for k in span if k in values])) for task, span in parts}

    def drawn_rows(self, masks: Mapping[int, np.ndarray]) -> Iterator[tuple[str, str, float]]:
        """IoU with drawn masks; if a rival does not show the frame, its nearest frame counts."""
        for frame, labels in self.drawn.items():
            nearest = min(masks, key=lambda other: abs(other - frame))
            yield "drawn", ("1/3", "2/3", "last")[3 * frame // self.count], iou_without_hands(masks[nearest], labels)


def pictures(run: Path, capture: Capture, frames: Collection[int]) -> dict[int, np.ndarray]:
    """RGBA [H, W, 4] of some frames, as the stage render draws them; after a divergence the last valid frame is repeated."""
    own, found = RunFolder.of(run), dict[int, np.ndarray]()
    if own.trajectory is None or "render" not in own.stages:
        return found
    images = parse(Images, own.records["render"].settings["images"], str(own.stages["render"].path))
    scored, last = Scored.of(capture, {}, images, "cpu"), None
    try:
        _, moved = posed(own.stages["appearance"], own.stages["rollout"], own.trajectory, "cpu")
        for frame in range(max(frames) + 1):
            last = next(moved, last)
            if frame in frames and last is not None:
                found[frame] = picture(last, scored.views[NAME], scored.backend)
    except NumericalFailure:
        pass
    return found


def runs_of(scene: Scene, methods: Collection[str]) -> dict[tuple[str, int], Path]:
    """(method, seed) -> folder of a finished run."""
    found = [path.parent for method in methods for path in sorted(scene.runs.glob(f"{method}/*/{RUN_RECORD}"))]
    return {(path.parent.name, int(path.name)): path for path in found}


def rows_of(scene: Scene, methods: Collection[str], kept: dict[str, np.ndarray], notes: list[str]) -> Iterator[tuple[object, ...]]:
    """Rows `COLUMNS` of a scene; adds predictions of `BEST` to `kept` and failures to `notes`."""
    for rival in RIVALS:
        masks, shift = scene.rival(rival)
        shown = dict(zip(scene.pairs, masks, strict=True))
        values = {frame: iou_without_hands(mask, scene.labels(frame)) for frame, mask in shown.items()}
        for row in (*(("carried", *item) for item in scene.means(values).items()), *scene.drawn_rows(shown)):
            yield scene.name, rival, 0, *row
        yield from ((scene.name, rival, 0, "shift", axis, value) for axis, value in zip("xy", shift, strict=True))
    silhouettes = []
    for (method, seed), folder in runs_of(scene, methods).items():
        record = RunRecord.load(folder / RUN_RECORD)
        if record.status == "failed":
            notes.append(f"{scene.name}, {method}, seed {seed} failed ({record.reason}); its last frame is repeated.")
        path = RunFolder.of(folder).file("render", "frames")
        if path is None:
            notes.append(f"{scene.name}, {method}, seed {seed} has no images.")
            continue
        table = pd.read_parquet(path)
        values = table[table["metric"] == "iou"].set_index("frame")["value"].to_dict()
        shown = {frame: values[frame] for frame in scene.pairs}
        yield from ((scene.name, method, seed, "carried", *item) for item in scene.means(shown).items())
        if method == BEST:
            own = {frame: rgba[..., 3] > 127 for frame, rgba in pictures(folder, scene.capture, scene.kept).items()}
            silhouettes.append(np.stack([np.packbits(own[frame]) for frame in scene.kept]))
            yield from ((scene.name, method, seed, *row) for row in scene.drawn_rows(own))
    if silhouettes:
        kept |= {scene.name: np.stack(silhouettes), f"{scene.name}_frames": np.array(scene.kept)}


def by_scene(scores: pd.DataFrame, part: str, masks: str = "carried") -> pd.DataFrame:
    """Means over seeds; one row per scene, one column per method."""
    own = scores[(scores["part"] == part) & (scores["masks"] == masks)]
    order = [name for name in dict.fromkeys(scores["method"]) if name not in RIVALS]
    wide = own.groupby(["case", "method"])["value"].mean().unstack("method")
    return wide[[name for name in (*order, *RIVALS) if name in wide]]


def spread(scores: pd.DataFrame, method: str, part: str, cases: Collection[str]) -> float:
    """Standard deviation over seeds of the mean over scenes; NaN for one seed."""
    own = scores[(scores["method"] == method) & (scores["part"] == part) & (scores["masks"] == "carried")]
    wide = own[own["case"].isin(cases)].pivot_table(index="case", columns="seed", values="value").reindex(list(cases))
    return float(wide.dropna(axis=1).mean().std(ddof=1))


def difference(table: pd.DataFrame, first: str, second: str) -> str:
    """First minus second, paired by scene, with the 95 % t interval and the number of scenes above 0."""
    values = (table[first] - table[second]).dropna().to_numpy()
    if len(values) < 2:
        return "–"
    low, high = t_interval(values)
    return f"{values.mean():+.3f} [{low:+.3f}, {high:+.3f}], {(values > 0).sum()} of {len(values)}"


def lines_of(scores: pd.DataFrame) -> Iterator[str]:
    """Lines of all tables."""
    for part in reversed(TASKS):
        table = by_scene(scores, part)
        rows = [[name, *map("{:.3f}".format, own)] for name, *own in table.itertuples()]
        new = table.index.isin(NEW)
        for name, chosen in {"all": new | True, "new": new, "known": ~new}.items():
            own = table[chosen].dropna()
            if not len(own):
                continue
            ends = [spread(scores, method, part, list(own.index)) for method in table]
            spreads = ["" if np.isnan(end) else f" ± {end:.3f}" for end in ends]
            rows.append([f"mean, {name} ({len(own)})", *(f"{m:.3f}{e}" for m, e in zip(own.mean(), spreads, strict=True))])
        yield from (f"\n## IoU, {part} frames\n", *Table.of_texts(["scene", *table], rows).markdown())
    yield "\n## Future IoU, first minus second, paired by scene, 95 % t intervals, scenes above 0\n"
    table = by_scene(scores, "future")
    new, names, rows = table[table.index.isin(NEW)], list(table), []
    pairs = [(name, rival) for rival in RIVALS for name in names if name not in RIVALS]
    pairs += [(BEST, name) for name in names if name not in (BEST, *RIVALS) and BEST in names] + [tuple(RIVALS)]
    for first, second in pairs:
        rows.append([first, second, difference(table, first, second), difference(new, first, second)])
    yield from Table.of_texts(["first", "second", "all scenes", "new scenes"], rows).markdown()
    drawn = scores[scores["masks"] == "drawn"]
    if len(drawn):
        wide = drawn.groupby(["case", "part", "method"])["value"].mean().unstack("method")
        means = pd.concat({"mean": wide.groupby("part").mean()})
        rows = [[*index, *map("{:.3f}".format, own)] for index, *own in pd.concat([wide, means]).itertuples()]
        yield from ("\n## IoU with drawn masks\n", *Table.of_texts(["scene", "frame", *wide], rows).markdown())


def hours(results: Path) -> Iterator[str]:
    """Hours of all finished jobs by rule; a job uses one core."""
    records = [(record.rule, record.log, record.seconds / 3600) for record in read_jobs(results, damaged=[]) if not record.failed]
    # Members of a batch share a log, and each has the time of the batch.
    jobs = pd.DataFrame(records, columns=["rule", "log", "hours"]).drop_duplicates("log")
    sums = jobs.groupby("rule")["hours"].agg(["size", "sum"]).sort_values("sum", ascending=False)
    sums.loc["all"] = sums.sum()
    rows = [[str(rule), f"{count:.0f}", f"{total:.2f}"] for rule, count, total in sums.itertuples()]
    yield from ("\n## Hours of jobs, one core each\n", *Table.of_texts(["rule", "jobs", "hours"], rows).markdown())


def strip(scene: Scene, folder: Path, shown: int = 6, width: int = 320) -> None:
    """Write FOLDER/CASE.jpg: evenly spaced frames around the object, below a bar in the color of training or future."""
    places = [int(k) for k in np.linspace(0, len(scene.pairs) - 1, shown)]
    frames = [scene.pairs[k] for k in places]
    colors = film(scene.data / "phystwin22_films", scene.name)
    rows = [[colors[frame] for frame in frames], *([scene.renders(rival)[k] for k in places] for rival in RIVALS)]
    for folder_of_run in list(runs_of(scene, [BEST]).values())[:1]:
        if drawn := pictures(folder_of_run, scene.capture, frames):
            rows.append([drawn[k][..., :3] + (0.3 * colors[k] * (1 - drawn[k][..., 3:] / 255)).astype(np.uint8) for k in frames])
    cut = np.argwhere(np.any([scene.labels(frame) == OBJECT for frame in frames], axis=0))
    (top, left), (bottom, right) = np.maximum(cut.min(axis=0) - 30, 0), cut.max(axis=0) + 30
    size = width, round(width * (bottom - top) / (right - left))
    lines = [np.hstack([np.full((10, width, 3), FUTURE if k >= scene.capture.train_end else TRAINING, np.uint8) for k in frames])]
    for row in rows:
        lines.append(np.hstack([cv2.resize(each[top:bottom, left:right], size, interpolation=cv2.INTER_AREA) for each in row]))
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / f"{scene.name}.jpg"), np.ascontiguousarray(np.vstack(lines)[..., ::-1]))


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--cores", type=int, default=2, help="0: run nothing")
    parser.add_argument("--only", default="", help="selection of runs, like the key `only` of the configuration")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--strips", type=Path, help="folder for strips of images")
    a = parser.parse_args()
    films, captures, results = a.data / "phystwin22_films", a.work / "captures", a.work / "results"
    if a.cores:
        write_captures(films, captures, cases_of(films))
        command = [sys.executable, "-m", "snakemake", "--profile", "workflow/profiles/default", "--quiet", "rules"]
        command += ["--cores", str(a.cores), "--configfile", str(CONFIG)]
        values = {"data_root": captures.resolve(), "results": results.resolve()} | ({"only": a.only} if a.only else {})
        subprocess.run([*command, "--config", *(f"{key}={value}" for key, value in values.items())], cwd=ROOT, check=True)
    methods, kept, notes, rows = read_yaml(CONFIG)["methods"], dict[str, np.ndarray](), list[str](), list[tuple[object, ...]]()
    for case in cases_of(films):
        if not any((results / f"{PREFIX}{case}").glob(f"*/*/{RUN_RECORD}")):
            continue
        scene = Scene(case, a.data, Capture.load(captures / f"{PREFIX}{case}"), results / f"{PREFIX}{case}")
        rows += rows_of(scene, methods, kept, notes)
        if a.strips:
            strip(scene, a.strips)
        print(case, flush=True)
    if a.output:
        scores, table, masks = pd.DataFrame(rows, columns=COLUMNS), a.output / "scores.csv", a.output / "silhouettes.npz"
        if table.exists():
            before = pd.read_csv(table)
            scores = pd.concat([before[~before["case"].isin(scores["case"])], scores], ignore_index=True)
            with np.load(masks) as stored:
                kept = dict(stored) | kept
        a.output.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(masks, **kept)
        write_text(table, scores.to_csv(index=False, float_format="%.4f"))
        title = f"# The paper's 22 scenes from video, one color camera; main method declared before the run: `{BEST}`"
        lines = [title, *lines_of(scores), *hours(results), "\n## Notes\n", *(f"- {note}" for note in notes)]
        write_text(a.output / "summary.md", "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
