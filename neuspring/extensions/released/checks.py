"""The checks of a case, and what a check finds: our number, the published one, how far they may differ, the verdict.

Checks: 1 sizes and frame 0, 2 springs, 3 scores of the prediction, 4 deprojection, 5 pictures, 6 replay."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from neuspring.checks.case import FINAL_DATA
from neuspring.config import Fit
from neuspring.config.images import Images
from neuspring.core.artifacts import Material, Observations, Simulation, Topology, Trajectory, Twin
from neuspring.core.errors import InputError
from neuspring.core.text import Progress
from neuspring.data.camera import Camera
from neuspring.extensions.released.files import (
    Released,
    ReleasedCheckpoint,
    depth_image,
    gated_lift,
    mirrored,
    read_checkpoint,
    read_parameters,
    read_picture,
    read_prediction,
    visible_pixels,
)
from neuspring.intake import phystwin
from neuspring.intake.phystwin import CALIBRATION, released_cases
from neuspring.intake.phystwin_raw import read_calibration
from neuspring.physics.stability import RELEASED_FRAME_TIME, RELEASED_SUBSTEPS
from neuspring.physics.topology import uniform_topology
from neuspring.scores import metrics
from neuspring.scores.lpips import Lpips
from neuspring.scores.metrics import METRICS, TASKS, averages
from neuspring.scores.paper import MEANS, Printed, Values, released_scores
from neuspring.scores.pictures import Pair, picture_scores
from neuspring.splats.draw import OBJECT_COVERAGE, picture, prune_by_opacity, skinned_frames, view_of
from neuspring.splats.model import Splats
from neuspring.twin.rollout import roll_out

Outcome = Literal["passed", "failed", "measured", "skipped"]
"""measured: there is no published number to compare with."""
MEAN = "mean"
"""The scenario of findings about all scenarios."""
MEAN_ROWS = (f"{MEANS}_REEVAL", f"{MEANS}_PAPER")
"""Rows of means over the 22 scenarios: evaluated again with more digits, as printed in the paper."""


class Absent(Exception):
    """The reason why a check cannot run, and the missing file if that is it."""

    def __init__(self, reason: str, file: Path | None = None) -> None:
        super().__init__(reason)
        self.file = file


def require(root: Path, *paths: Path) -> None:
    """Raise Absent for the first path that is not there."""
    for path in paths:
        if not path.exists():
            raise Absent(f"{path.relative_to(root)} is not there", path)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One line of a check."""

    check: int
    scenario: str
    """Its name, or MEAN."""
    quantity: str
    unit: str = ""
    task: str = ""
    """reconstruction, future, or empty."""
    ours: float | None = None
    published: float | None = None
    """The released or published number; 0 for distances from released positions."""
    tolerance: float | None = None
    outcome: Outcome = "measured"
    note: str = ""
    frames: int = 0
    """Number of frames that a score is the mean of."""
    file: Path | None = field(default=None, compare=False, repr=False)
    """The file that is checked."""
    per_frame: np.ndarray | None = field(default=None, compare=False, repr=False)

    @property
    def difference(self) -> float | None:
        """Ours minus the published number."""
        return None if self.ours is None or self.published is None else self.ours - self.published

    def against(self, published: float, tolerance: float) -> Comparison:
        """The finding with its verdict: passed or failed, by the tolerance."""
        assert self.ours is not None
        good = abs(self.ours - published) <= tolerance  # false for NaN
        return replace(self, published=published, tolerance=tolerance, outcome="passed" if good else "failed")


@dataclass(frozen=True, kw_only=True)
class Published:
    """Published scores of the released results, by (scenario, task, metric). Means stand under the names in MEAN_ROWS."""

    scores: Values
    scenarios: frozenset[str]
    """The scenarios that the means were taken over."""

    @classmethod
    def load(cls) -> Published:
        """The table that ships."""
        return cls(scores=released_scores(), scenarios=frozenset(released_cases()))

    def means(self, task: str, metric: str) -> list[Printed]:
        """Published means of a task and metric, the one with most digits first."""
        keys = [(name, task, metric) for name in MEAN_ROWS]
        return [self.scores[key] for key in keys if key in self.scores]


@dataclass(frozen=True, kw_only=True)
class Tools:
    """Tools that the checks of every case share."""

    published: Published
    device: str = "cpu"
    """Device of checks 5 and 6."""
    lpips: Lpips | str = ""
    """The metric, or the reason why there is none."""


def of_scores(
    base: Comparison, scores: pd.DataFrame, metrics: Sequence[str], published: Published, missing: Mapping[str, str]
) -> list[Comparison]:
    """Findings for tidy scores of one scenario, with check, scenario and file of `base`.

    `missing`: metric -> the reason why it has no score.
    """
    rows = {(row["task"], row["metric"]): row for row in scores.to_dict("records")}
    findings = []
    for metric in metrics:
        blank = replace(base, quantity=metric, unit=METRICS[metric].unit)
        if metric in missing:
            findings.append(replace(blank, outcome="skipped", note=missing[metric]))
            continue
        for task in TASKS:
            if (task, metric) not in rows:
                findings.append(replace(blank, task=task, outcome="skipped", note="no frame has it"))
                continue
            row = rows[task, metric]
            score = replace(blank, task=task, ours=float(row["value"]), frames=int(row["frames"]))
            findings.append(_judged(score, published.scores.get((base.scenario, task, metric))))
    return findings


def _judged(score: Comparison, reference: Printed | None) -> Comparison:
    if reference is None:
        return score
    return score.against(reference.value, max(METRICS[score.quantity].tolerance, reference.slack))


def of_means(findings: Iterable[Comparison], published: Published) -> list[Comparison]:
    """Findings about means over scenarios. Only means over the complete set are compared with the published ones."""
    rows = [
        {"check": f.check, "scenario": f.scenario, "seed": 0, "task": f.task, "metric": f.quantity, "value": f.ours}
        | {"frames": f.frames}
        for f in findings
        if f.frames and f.ours is not None
    ]
    if not rows:
        return []
    table = pd.DataFrame(rows)
    means = []
    for row in averages(table, by=("check", "task", "metric")).to_dict("records"):
        same = (table["check"] == row["check"]) & (table["task"] == row["task"]) & (table["metric"] == row["metric"])
        means.append(_mean(row, table[same], published))
    return means


def _mean(row: Mapping[Any, Any], scores: pd.DataFrame, published: Published) -> Comparison:
    """The mean of one metric in one task; `row` is its average, `scores` are the scores of the scenarios."""
    weighted = METRICS[row["metric"]].average == "frames"
    references = published.means(row["task"], row["metric"])
    whole = frozenset(scores["scenario"]) == published.scenarios
    note = f"{'frame' if weighted else 'scenario'}-weighted over {len(scores)} scenarios"
    if references and not whole:
        note += f"; published {references[0].value:g} over {len(published.scenarios)}"
    elif len(references) > 1:
        note += f"; paper: {references[1].value:g}"
    mean = Comparison(
        check=row["check"],
        scenario=MEAN,
        quantity=row["metric"],
        unit=METRICS[row["metric"]].unit,
        task=row["task"],
        ours=float(row["mean"]),
        frames=int(scores["frames"].sum()),
        note=note,
    )
    return _judged(mean, references[0] if references and whole else None)


DISTANCES = ("chamfer", "track_error")
POSITION = 2e-5
"""m, mean over nodes: within this, recorded clips of the released simulator are followed."""
REPLAY_SPREAD = 10.0
"""A replay may differ from the released one by this many times the effect of the order of additions alone: on a GPU that order is
not defined, and contacts between nodes flip with rounding. On the recorded clips the largest ratio was 2.4."""


def sizes(case: Released, observations: Observations, _: Tools) -> list[Comparison]:
    """Check 1: sizes of the case against the table of released cases."""
    row = released_cases().get(case.name)
    quantities = {
        "frames": observations.scenario.frame_count,
        "train_end": observations.scenario.train_end,
        "object_points": observations.object_points.shape[1],
        "nodes": len(observations.nodes),
    }
    findings = []
    for name, count in quantities.items():
        finding = Comparison(check=1, scenario=case.name, quantity=name, ours=count, file=case.folder / FINAL_DATA)
        if row is None:
            finding = replace(finding, note="not one of the 22 released cases")
        elif row[name]:
            finding = replace(finding, note="against the table of released cases").against(int(row[name]), 0)
        findings.append(finding)
    return findings


def first_frame(case: Released, observations: Observations, _: Tools) -> list[Comparison]:
    """Check 1: frame 0 of the released prediction is [object_points[0] | surface_points | interior_points] in float32."""
    positions = _prediction(case, observations)
    different = np.flatnonzero((positions[0] != observations.nodes).any(axis=1))
    note = "frame 0 must equal [object_points[0] | surface_points | interior_points] in float32"
    if len(different):
        largest = float(np.abs(positions[0] - observations.nodes).max())
        note += f"; first other node {different[0]}, largest difference {largest:.3g} m"
    finding = Comparison(check=1, scenario=case.name, quantity="other nodes in frame 0", note=note, file=case.prediction)
    return [replace(finding, ours=len(different)).against(0, 0)]


def topology(case: Released, observations: Observations, _: Tools) -> list[Comparison]:
    """Check 2: the rebuilt springs against the checkpoint and the table of released cases, which also knows the best epoch."""
    require(case.root, case.parameters, case.checkpoint)
    parameters, checkpoint = read_parameters(case.parameters), read_checkpoint(case.checkpoint)
    rebuilt = _springs(observations, parameters)
    counts = [
        ("springs", len(rebuilt.springs), len(checkpoint.stiffness), "the checkpoint"),
        ("object springs", rebuilt.object_spring_count, checkpoint.object_springs, "the checkpoint"),
    ]
    if (row := released_cases().get(case.name)) is not None:
        counts.append(("springs", len(rebuilt.springs), int(row["springs"]), "the table of released cases"))
        counts.append(("best epoch", case.epoch, int(row["best_epoch"]), "the table of released cases"))
    return [
        Comparison(check=2, scenario=case.name, quantity=name, ours=ours, note=f"against {source}", file=case.checkpoint).against(
            theirs, 0
        )
        for name, ours, theirs, source in counts
    ]


def evaluator(case: Released, observations: Observations, tools: Tools) -> list[Comparison]:
    """Check 3: our metrics of the released prediction."""
    positions = _prediction(case, observations)
    trajectory = Trajectory(positions=positions, frame_count=len(positions))
    scores = metrics.score(trajectory, observations, "released", 0)
    missing = (
        {} if observations.tracks.shape[1] else {"track_error": f"no annotated tracks in {phystwin.GT_TRACKS}, or no such file"}
    )
    base = Comparison(check=3, scenario=case.name, quantity="", file=case.prediction)
    return of_scores(base, scores, DISTANCES, tools.published, missing)


def simulator(case: Released, observations: Observations, tools: Tools) -> list[Comparison]:
    """Check 6: replays of the checkpoint against the released prediction.

    One replay truncates the dampings to whole numbers, as the released code does; one does not. A third with the nodes in another
    order measures the effect of the order of additions alone.
    """
    require(case.root, case.parameters, case.checkpoint)
    released = _prediction(case, observations)
    parameters, checkpoint = read_parameters(case.parameters), read_checkpoint(case.checkpoint)
    twin = released_twin(observations, parameters, checkpoint, case)
    truncated = damped(twin, *(float(int(parameters[key])) for key in ("drag_damping", "dashpot_damping")))
    device = tools.device
    first = replay(truncated, observations.controller_points, device, case.name)
    second = replay(_reordered(truncated), observations.controller_points, device, f"{case.name}, other order")
    exact = replay(twin, observations.controller_points, device, f"{case.name}, float damping")
    order = _apart(first.positions, second.positions[:, ::-1]).mean(axis=1)
    findings = _replayed(case.name, "dampings truncated", first, released, order)
    findings.append(_largest(case.name, "mean distance of nodes, nodes in another order", order))
    whole = truncated.material.drag == twin.material.drag and np.array_equal(truncated.material.dashpot, twin.material.dashpot)
    note = "both dampings are whole numbers: the same replay" if whole else ""
    for name, values in _distances("float dampings", _apart(exact.positions, released)).items():
        findings.append(_largest(case.name, name, values, "; ".join(filter(None, (note, exact.reason)))))
    return findings


def released_twin(observations: Observations, parameters: dict[str, float], checkpoint: ReleasedCheckpoint, case: Released) -> Twin:
    """The checkpoint as a twin with the searched dampings. Raises InputError if springs and checkpoint do not belong together."""
    springs = _springs(observations, parameters)
    if len(springs.springs) != len(checkpoint.stiffness):
        rule = f"one stiffness for each of the {len(springs.springs)} rebuilt springs is required"
        raise InputError(case.checkpoint, rule, len(checkpoint.stiffness), "See check 2.")
    if checkpoint.contact is None:
        raise InputError(case.checkpoint, "the four scalars of contact are required", "not all of them")
    material = Material(
        stiffness=checkpoint.stiffness.clip(*Fit().stiffness_range),
        dashpot=np.full(len(checkpoint.stiffness), parameters["dashpot_damping"]),
        drag=parameters["drag_damping"],
        contact_distance=parameters["collision_dist"],
        **checkpoint.contact,  # type: ignore[arg-type]
    )
    scenario = observations.scenario
    simulation = Simulation(
        frame_time=RELEASED_FRAME_TIME,
        substeps=RELEASED_SUBSTEPS,
        up=scenario.up,
        ground=scenario.ground,
        self_collision=scenario.self_collision,
    )
    return Twin(topology=springs, material=material, simulation=simulation)


def damped(twin: Twin, drag: float, dashpot: float) -> Twin:
    """The twin with other dampings, 1/s and N s/m."""
    material = replace(twin.material, drag=drag, dashpot=np.full(len(twin.material.dashpot), dashpot))
    return replace(twin, material=material)


def replay(twin: Twin, controller_points: np.ndarray, device: str, label: str) -> Trajectory:
    """Simulate as the released simulator does: without our bound on the substep."""
    progress = Progress(f"replay {label}", len(controller_points) - 1)
    return roll_out(twin, controller_points, device, progress.update, check=False)


def _prediction(case: Released, observations: Observations) -> np.ndarray:
    require(case.root, case.prediction)
    return read_prediction(case.prediction, observations.scenario.frame_count, len(observations.nodes))


def _springs(observations: Observations, parameters: dict[str, float]) -> Topology:
    return uniform_topology(
        observations.nodes,
        observations.controller_points[0],
        parameters["object_radius"],
        int(parameters["object_max_neighbours"]),
        parameters["controller_radius"],
        int(parameters["controller_max_neighbours"]),
    )


def _reordered(twin: Twin) -> Twin:
    """The same twin with its nodes in reverse order: a node's forces are summed in the order of its partners."""
    graph = twin.topology
    nodes = len(graph.nodes)
    springs = np.where(graph.springs < nodes, nodes - 1 - graph.springs, graph.springs)
    return replace(twin, topology=replace(graph, nodes=graph.nodes[::-1], labels=graph.labels[::-1], springs=springs))


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of each node in each frame that both have [F, N], m."""
    shared = min(len(a), len(b))
    distance: np.ndarray = np.linalg.norm(a[:shared].astype(np.float64) - b[:shared], axis=2)
    return distance


def _distances(label: str, apart: np.ndarray) -> dict[str, np.ndarray]:
    return {f"mean distance of nodes, {label}": apart.mean(axis=1), f"largest distance of a node, {label}": apart.max(axis=1)}


def _replayed(scenario: str, label: str, own: Trajectory, released: np.ndarray, order: np.ndarray) -> list[Comparison]:
    """The mean distance, judged in its worst frame relative to the allowance there, and the largest distance, measured."""
    (name, mean), (other, largest) = _distances(label, _apart(own.positions, released)).items()
    # Until the next frame: which of two replays flips a contact first is chance.
    reached = np.maximum.accumulate(np.append(order[1:], order[-1]))
    allowed = POSITION + REPLAY_SPREAD * np.pad(reached, (0, len(mean) - len(order)), mode="edge")
    worst = int(np.argmax(mean / allowed))
    rule = f"allowed: {POSITION:g} m plus {REPLAY_SPREAD:g} times the effect of the order of nodes"
    judged = _at(scenario, name, mean, worst, rule).against(0.0, float(allowed[worst]))
    if own.diverged_frame is not None:
        judged = replace(judged, outcome="failed", note=own.reason)
    overflow = f"{own.collision_overflow} collision candidates did not fit" if own.collision_overflow else ""
    return [judged, _largest(scenario, other, largest, overflow)]


def _largest(scenario: str, quantity: str, per_frame: np.ndarray, note: str = "") -> Comparison:
    return _at(scenario, quantity, per_frame, int(np.argmax(per_frame)), note)


def _at(scenario: str, quantity: str, per_frame: np.ndarray, frame: int, note: str) -> Comparison:
    """A distance in one frame, measured."""
    note = "; ".join(filter(None, (f"frame {frame}", note)))
    value = float(per_frame[frame])
    return Comparison(check=6, scenario=scenario, quantity=quantity, unit="m", ours=value, note=note, per_frame=per_frame)


PICTURE_SCORES = ("psnr", "ssim", "lpips", "iou")
AS_RELEASED = Images(
    # gsplat since version 1.5 has another threshold of coverage than the released evaluation; ours has the same.
    backend="warp",
    released_quirks=("second_camera_intrinsics", "any_alpha", "unit_lpips", "degenerate_skinning", "unturned_harmonics"),
    corner_pixels=True,
)
"""Settings by which the released pictures were made and scored: first view, every quirk."""
LIFTED = 1e-4
"""m: points lifted with the right principal point come back but for rounding; with the other, the nearest is about 1 mm off."""
TRUE, MIRRORED = "c_x", "W - c_x"


def deprojection(case: Released, observations: Observations, _: Tools) -> list[Comparison]:
    """Check 4: lifting the tracked pixels of frame 0 with one of two principal points must give the released points.

    Every released point of frame 0 must have a lifted one close to it, over all cameras. The converse would not hold: the released
    processing drops lifted points.
    """
    require(case.root, case.folder / phystwin.METADATA, case.folder / CALIBRATION)
    cameras = read_calibration(case.folder)[1]
    require(case.root, *(path for c in cameras for path in (case.pixel_tracks(c.name), case.first_depth(c.name))))
    raw = {c.name: (visible_pixels(case.pixel_tracks(c.name)), depth_image(case.first_depth(c.name), c)) for c in cameras}
    residuals = {}
    for convention, used in ((TRUE, cameras), (MIRRORED, [mirrored(c) for c in cameras])):
        if not len(lifted := np.concatenate([gated_lift(camera, *raw[camera.name]) for camera in used])):
            raise Absent("no tracked pixel of frame 0 has a depth within the gate")
        residuals[convention] = float(np.median(cKDTree(lifted).query(observations.object_points[0])[0]))
    if max(residuals.values()) <= LIFTED:
        raise Absent(f"c_x and W - c_x give the same points: {residuals[TRUE]:.3g} and {residuals[MIRRORED]:.3g} m")
    better = min(residuals, key=lambda name: residuals[name])
    findings = []
    for convention, residual in residuals.items():
        quantity = f"distance to the points lifted with {convention}"
        file = case.pixel_tracks(cameras[0].name)
        finding = Comparison(check=4, scenario=case.name, quantity=quantity, unit="m", ours=residual, file=file)
        if convention == better:
            note = f"the data follow {convention}" if residual <= LIFTED else "neither fits"
            finding = replace(finding, note=note).against(0.0, LIFTED)
        findings.append(finding)
    return findings


def renderer(case: Released, observations: Observations, tools: Tools) -> list[Comparison]:
    """Check 5: the released splats, moved by the released prediction, drawn and scored as released."""
    calibration = (case.folder / phystwin.METADATA, case.folder / CALIBRATION)
    require(case.root, case.splats, case.prediction, case.object_masks, case.human_masks, case.colors, *calibration)
    rows = frame_scores(case, observations, tools.lpips, tools.device)
    scores = metrics.score_images(rows, observations.scenario, observations.scenario.frame_count, "released", 0)
    missing = {"lpips": f"not computed: {tools.lpips}"} if isinstance(tools.lpips, str) else {}
    return of_scores(Comparison(check=5, scenario=case.name, quantity=""), scores, PICTURE_SCORES, tools.published, missing)


def frame_scores(
    case: Released, observations: Observations, lpips: Lpips | str, device: str, images: Images = AS_RELEASED
) -> pd.DataFrame:
    """Columns frame, camera, metric, value of every frame but the first, seen by the first camera."""
    cameras = read_calibration(case.folder)[1]
    if len(cameras) < 2:
        raise InputError(case.folder / phystwin.METADATA, "a second camera is required: pictures have its intrinsics", len(cameras))
    camera, borrowed = cameras[0], cameras[1] if "second_camera_intrinsics" in images.released_quirks else None
    view = view_of(camera, images, device, borrowed)
    splats = prune_by_opacity(Splats.load(case.splats))
    positions = read_prediction(case.prediction, observations.scenario.frame_count, len(observations.nodes))
    progress = Progress(f"pictures {case.name}", len(positions))
    rows = []
    for frame, gaussians in enumerate(skinned_frames(splats, positions, images, device)):
        if frame:
            values = _scores(case, camera, frame, picture(gaussians, view, "warp"), lpips, images)
            rows += [{"frame": frame, "camera": camera.name, "metric": name, "value": value} for name, value in values.items()]
        progress.update(frame + 1)
    return pd.DataFrame(rows, columns=["frame", "camera", "metric", "value"])


def _scores(
    case: Released, camera: Camera, frame: int, rendered: np.ndarray, lpips: Lpips | str, images: Images
) -> dict[str, float]:
    name, quirks = f"{frame}.png", images.released_quirks
    observed = read_picture(case.colors / name, camera)
    mask = read_picture(case.object_masks / name, camera, gray=True)
    human = read_picture(case.human_masks / name, camera, gray=True)
    pair = Pair.of(observed, rendered, mask, human, 1 if "any_alpha" in quirks else OBJECT_COVERAGE)
    return picture_scores(pair, lpips, unit_lpips="unit_lpips" in quirks)
