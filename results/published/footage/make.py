"""Twins of color footage beside PhysTwin's published prediction, on the same frames of the same camera: tables and film strips.

    python -m results.published.footage.make FOLDER RESULTS --captures CAPTURES --output OUT
        [--cases ...] [--methods ...] [--hands FOLDER] [--strips FOLDER] [--strip-methods ...] [--force] [--keep]

FOLDER is that of `film`, with result/CASE.npz and videos/combine_rendering__CASE.mp4. RESULTS is a folder of
results of the workflow. CAPTURES has a capture per case (`results.published.footage.captures`). Cases are those that RESULTS has
runs of; without any run, all captures. OUT/summary.md has the tables, OUT/scores.csv every number, OUT/costs.csv the times. Scores
of runs that have not changed are taken from an earlier OUT/scores.csv; --force computes all anew. With --keep, runs of the earlier
files that RESULTS does not have stay in them: so one table may hold the runs of several machines. Films whose marks are not of
frame 0 alone have tables of their own. FOLDER of --hands is that of `results.published.scenes.captures`, for a table of how far
off the hands were (`hands`).
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from neuspring.core.files import write_text
from neuspring.core.records import digest_file
from neuspring.data.capture import CAPTURE, HANDS, OBJECT
from neuspring.draw.sheet import FUTURE, TRAINING
from neuspring.scores.carried import carried_in_image, points_on_table
from neuspring.scores.pictures import Pair, picture_scores
from neuspring.splats.draw import OBJECT_COVERAGE
from results.published.footage.captures import CARRYING
from results.published.footage.hands import hand_lines, hand_rows
from results.published.footage.runs import PHYSTWIN, STILL, Case, Run, cases_of, corrected, iou_without_hands, runs_of
from results.published.footage.tables import COLUMNS, PARTS, cost_lines, costs, merged, tables

IMAGE_METRICS = ("iou", "psnr", "ssim")
NO_LPIPS = "not compared here"
COSTS = "costs.csv"
MM = 1e3
Row = dict[str, Any]


def labeled_rows(case: Case, silhouettes: Iterable[tuple[int, np.ndarray]]) -> Iterator[Row]:
    """IoU in the labeled frames, of silhouettes [H, W] by frame. Frames are told by their place among the labeled ones."""
    parts, metric = dict(zip(case.labeled, PARTS, strict=True)), "iou_drawn" if case.drawn else "iou_carried"
    for frame, silhouette in silhouettes:
        value = iou_without_hands(silhouette, case.labeled[frame])
        yield {"part": parts[frame], "frame": frame, "metric": metric, "value": value}


def task_rows(case: Case, values: pd.DataFrame) -> Iterator[Row]:
    """Means over the frames of both tasks of values by frame and metric. Pictures black on both sides have no finite PSNR."""
    values = values[np.isfinite(values["value"])]
    for task, span in case.tasks.items():
        part = values[values["frame"].isin(span)]
        for metric in IMAGE_METRICS:
            own = part.loc[part["metric"] == metric, "value"]
            if len(own):
                yield {"part": task, "metric": metric, "value": float(own.mean())}


def picture_rows(case: Case, pictures: Iterable[tuple[int, np.ndarray]]) -> Iterator[Row]:
    """Means as the render stage scores them, of RGBA pictures [H, W, 4] over black by frame."""
    values = []
    for frame, rgba in pictures:
        labels = case.labels(frame)
        mask, hands = (np.where(labels == label, 255, 0).astype(np.uint8) for label in (OBJECT, HANDS))
        scores = picture_scores(Pair.of(case.color(frame), rgba, mask, hands, OBJECT_COVERAGE), NO_LPIPS, unit_lpips=False)
        values += [{"frame": frame, "metric": name, "value": value} for name, value in scores.items()]
    yield from task_rows(case, pd.DataFrame(values, columns=["frame", "metric", "value"]))


def point_rows(case: Case, positions: np.ndarray | None, run: Run | None) -> Iterator[Row]:
    """Errors of the sure marked points, px: in the last marked frame, and in all marked frames after 0.

    Of flat things also in mm, of points that touch the table. Without positions [T, N, 3] points stay where they are in frame 0.
    """
    points = case.points
    if points is None:
        return
    marked = np.where(points.sure[..., None], points.xy, np.nan).transpose(1, 0, 2)
    if positions is None or run is None:
        errors = np.linalg.norm(marked - marked[0], axis=2)
    else:
        camera = case.capture.cameras[case.camera]
        chosen = positions[np.minimum(points.frames, len(positions) - 1)]
        view = camera.intrinsics, camera.camera_to_world, chosen, marked, run.observations.surface_count
        places = carried_in_image(*view[:3], marked[0], view[4])
        errors = np.linalg.norm(places - marked[: len(places)], axis=2)
        distances = points_on_table(*view, 1.0 if run.observations.scenario.up == "+z" else -1.0)[1:]
        if np.isfinite(distances).any():
            yield {"part": "later", "metric": "points_table", "value": MM * float(np.nanmean(distances))}
    for part, own in (("last", errors[-1]), ("later", errors[1:])):
        found = own[np.isfinite(own)]
        if len(found):
            facts = {"median": float(np.median(found)), "mean": float(found.mean()), "count": len(found)}
            yield from ({"part": part, "metric": f"points_{name}", "value": value} for name, value in facts.items())


def published_rows(case: Case) -> list[Row]:
    """PhysTwin's; empty where its prediction cannot be read back."""
    published = case.published
    if published is None:
        return []
    frames = range(1, min(case.capture.frame_count, published.frame_count))
    shift = [{"part": "0", "metric": f"shift_{axis}", "value": value} for axis, value in zip("xy", published.shift, strict=True)]
    own = labeled_rows(case, ((frame, published.silhouette(frame)) for frame in case.labeled if frame < published.frame_count))
    return [*shift, *own, *picture_rows(case, ((frame, published.picture(frame)) for frame in frames))]


def still_rows(case: Case) -> list[Row]:
    """Rows of a prediction that nothing moves: the object as it is seen in frame 0, cut out by the capture's mask."""
    covered = case.labels(0) == OBJECT
    rgba = np.dstack([np.where(covered[..., None], case.color(0), 0), np.where(covered, 255, 0)]).astype(np.uint8)
    own = labeled_rows(case, ((frame, covered) for frame in case.labeled))
    pictures = picture_rows(case, ((frame, rgba) for frame in range(1, case.capture.frame_count)))
    return [*own, *pictures, *point_rows(case, None, None)]


def run_rows(case: Case, run: Run) -> list[Row]:
    """Rows of a run; empty where it has no trajectory."""
    positions = run.positions()
    if positions is None:
        return []
    rows = list(labeled_rows(case, ((frame, covered) for frame, _, covered in run.pictures(case.capture, set(case.labeled)))))
    if frames := run.stage("render", "frames"):
        table = pd.read_parquet(frames)
        rows += task_rows(case, table[table["camera"].astype(str) == case.camera])
    return [*rows, *point_rows(case, positions, run)]


class Scores:
    """Tidy scores, and those of an earlier call by the key of what they are of. `keep`: those that this call has not stay."""

    def __init__(self, path: Path, *, force: bool, keep: bool) -> None:
        self.path, self.rows, self.keep = path, list[Row](), keep
        self._earlier: dict[str, list[Row]] = {}
        self._fresh: set[tuple[str, str, int]] = set()
        self._force = force
        if path.is_file():
            table = pd.read_csv(path, dtype={"part": str, "key": str})
            self._earlier = {str(key): part.to_dict("records") for key, part in table.groupby("key", sort=False)}

    def add(self, case: str, method: str, seed: int, key: str, compute: Any) -> int:
        """Rows of one prediction, computed where they are not known; returns how many."""
        key = f"{case}/{method}/{seed}/{key}"
        rows = None if self._force else self._earlier.get(key)
        if rows is None:
            rows = [{"case": case, "method": method, "seed": seed, "key": key} | row for row in compute()]
        self.rows += rows
        self._fresh.add((case, method, seed))
        return len(rows)

    @property
    def table(self) -> pd.DataFrame:
        rows = list(self.rows)
        for kept in self._earlier.values() if self.keep else ():
            first = kept[0]
            if (first["case"], first["method"], int(first["seed"])) not in self._fresh:
                rows += kept
        # By case, so that a table is the same whichever runs were added last.
        return pd.DataFrame(rows, columns=list(COLUMNS)).sort_values("case", kind="stable", ignore_index=True)

    def save(self) -> None:
        """So that an interrupted call loses little."""
        write_text(self.path, self.table.to_csv(index=False))


SHOWN = 6
"""Frames of a strip."""
WHITE = 0.3
"""Share of white that PhysTwin's video has laid over its frames."""
MARGIN = 24
"""px around object and hands."""
WIDTH = 360
"""Width of a picture of the strip, px."""
BAR, GAP = 24, 3
"""Height of the bar of time and width of gaps, px."""
INK = (40, 40, 40)


def frames_shown(count: int, shown: int = SHOWN) -> list[int]:
    """Evenly spaced frames, the first and the last among them."""
    return [int(frame) for frame in np.round(np.linspace(0, count - 1, shown))]


def surroundings(masks: Sequence[np.ndarray], margin: int = MARGIN) -> tuple[slice, slice]:
    """Rows and columns of what any of the masks [H, W] covers, with a margin; the whole image where they are empty."""
    covered = np.any([mask > 0 for mask in masks], axis=0)
    if not covered.any():
        return slice(None), slice(None)
    spans = []
    for axis in (1, 0):
        places = np.flatnonzero(covered.any(axis=axis))
        spans.append(slice(max(int(places[0]) - margin, 0), int(places[-1]) + margin + 1))
    return spans[0], spans[1]


def over_white(observed: np.ndarray, rgba: np.ndarray) -> np.ndarray:
    """A picture [H, W, 4] over black, laid over the whitened observed frame [H, W, 3]; uint8."""
    pale = (1 - WHITE) * observed.astype(np.float32) + WHITE * 255
    return np.clip(np.round(rgba[..., :3] + pale * (1 - rgba[..., 3:] / 255)), 0, 255).astype(np.uint8)


def layout(rows: dict[str, list[np.ndarray]], frames: Sequence[int], train_end: int) -> np.ndarray:
    """Rows of pictures [h, w, 3] of equal size under a bar of time, their names in the first column: RGB [H, W, 3] uint8."""
    height, width = next(iter(rows.values()))[0].shape[:2]
    size = (WIDTH, round(height * WIDTH / width))
    bars = []
    for frame in frames:
        bar = np.full((BAR, WIDTH, 3), FUTURE if frame >= train_end else TRAINING, np.uint8)
        bars.append(_written(bar, f"frame {frame}" + (", future" if frame >= train_end else ""), BAR - 7))
    lines = [_beside(bars)]
    for name, pictures in rows.items():
        small = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures]
        lines.append(_beside([_written(small[0], name, 20, shade=True), *small[1:]]))
    gap = np.full((GAP, lines[0].shape[1], 3), 255, np.uint8)
    return np.vstack([part for line in lines for part in (line, gap)][:-1])


def write_strip(case: Case, runs: Sequence[Run], folder: Path) -> Path:
    """Write FOLDER/CASE.jpg with a row per run that has pictures; returns its path."""
    published, count = case.published, case.capture.frame_count
    count = count if published is None else min(count, published.frame_count)
    frames = frames_shown(count)
    observed = {frame: case.color(frame) for frame in frames}
    rows = {"observed": list(observed.values())}
    if published is not None:
        # Not moved: the video as it is.
        rows[PHYSTWIN] = [published.rights[frame] for frame in frames]
    for run in runs:
        drawn = {frame: over_white(observed[frame], rgba) for frame, rgba, _ in run.pictures(case.capture, set(frames))}
        if len(drawn) == len(set(frames)):
            rows[f"{run.method}, seed {run.seed}"] = [drawn[frame] for frame in frames]
    cut = surroundings([case.labels(frame) for frame in frames])
    strip = layout({name: [picture[cut] for picture in own] for name, own in rows.items()}, frames, case.capture.train_end)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{case.name}.jpg"
    ok, data = cv2.imencode(".jpg", np.ascontiguousarray(strip[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 88])
    assert ok, "a picture can be encoded"
    path.write_bytes(data.tobytes())
    return path


def _beside(pictures: Sequence[np.ndarray]) -> np.ndarray:
    gap = np.full((pictures[0].shape[0], GAP, 3), 255, np.uint8)
    return np.hstack([part for picture in pictures for part in (picture, gap)][:-1])


def _written(picture: np.ndarray, text: str, baseline: int, *, shade: bool = False) -> np.ndarray:
    """A copy with a line of text at its top left, on a light ground if asked for."""
    copy, font, scale = np.ascontiguousarray(picture).copy(), cv2.FONT_HERSHEY_SIMPLEX, 0.5
    if shade:
        (width, _), _ = cv2.getTextSize(text, font, scale, 1)
        cv2.rectangle(copy, (0, 0), (width + 10, baseline + 7), (255, 255, 255), -1)
    cv2.putText(copy, text, (5, baseline), font, scale, INK, 1, cv2.LINE_AA)
    return copy


def main() -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("--captures", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--cases", nargs="+")
    parser.add_argument("--methods", nargs="*", help="all that have runs by default; none: PhysTwin alone")
    parser.add_argument("--hands", type=Path, help="folder of captures of points, CASE_points")
    parser.add_argument("--strips", type=Path, help="folder of film strips")
    parser.add_argument("--strip-methods", nargs="*", default=["neuspring"])
    parser.add_argument("--force", action="store_true")
    parser.add_argument("--keep", action="store_true", help="runs of an earlier call that RESULTS does not have stay in the tables")
    a = parser.parse_args()
    cases = cases_of(a.folder, a.captures, a.cases)
    runs = {case.name: runs_of(a.results, case.name, a.methods) for case in cases}
    if any(runs.values()) and a.cases is None:
        cases = [case for case in cases if runs[case.name]]
    scores, notes = Scores(a.output / "scores.csv", force=a.force, keep=a.keep), []
    for case in cases:
        stamp = digest_file(case.capture.folder / CAPTURE)[:16]
        if not scores.add(case.name, PHYSTWIN, 0, stamp, lambda case=case: published_rows(case)):
            notes.append(f"{case.name}: PhysTwin's prediction is not there to be read back.")
        scores.add(case.name, STILL, 0, stamp, lambda case=case: still_rows(case))
        for run in runs[case.name]:
            count = scores.add(
                case.name, run.method, run.seed, f"{stamp}-{run.key}", lambda case=case, run=run: run_rows(case, run)
            )
            if run.record.status == "failed":
                what = "its last frame stands for the rest" if count else "it has no scores"
                notes.append(f"{case.name}, {run.method}, seed {run.seed} failed ({run.record.reason}): {what}.")
        scores.save()
        print(f"{case.name}: {len(runs[case.name])} runs", flush=True)
        if a.strips:
            chosen = {run.method: run for run in reversed(runs[case.name]) if run.method in a.strip_methods}
            print(write_strip(case, [chosen[name] for name in a.strip_methods if name in chosen], a.strips), flush=True)
        # Frames of a video are large.
        case.__dict__.pop("published", None)
    carrying = {
        run.scenario: float(case.capture.description.provenance.get(CARRYING, "nan")) for case in cases for run in runs[case.name]
    }
    spent = costs(a.results, [run for case in cases for run in runs[case.name]], carrying)
    if a.keep and (a.output / COSTS).is_file():
        spent = merged(spent, pd.read_csv(a.output / COSTS))
    write_text(a.output / COSTS, spent.to_csv(index=False, float_format="%.3f"))
    later = scores.table["case"].isin(corrected())
    lines = tables(scores.table[~later], notes)
    if later.any():
        lines += ["", *tables(scores.table[later], [], "Films with correction marks in later frames")]
    if a.hands:
        hands = hand_rows(a.hands, [run.scenario for case in cases for run in runs[case.name][:1]])
        write_text(a.output / "hands.csv", hands.to_csv(index=False, float_format="%.2f"))
        lines += hand_lines(hands)
    lines += cost_lines(spent)
    write_text(a.output / "summary.md", "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
