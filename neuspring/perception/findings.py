"""What the steps of perception notice about their own results: masks, tracks, lifted points, the shape and the observations.

Limits were chosen so that the synthetic scenes pass, whose perception is known to be good; lengths in m, of things that hands hold
on a table.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from scipy.spatial import cKDTree

from neuspring.core.artifacts import ImageObservations, Observations
from neuspring.core.findings import Finding, Level, finding
from neuspring.data.capture import HANDS, OBJECT, Capture
from neuspring.data.plausible import (
    FEWEST_STEPS,
    REMEDY,
    Sample,
    Shown,
    depth_findings,
    hand_findings,
    mask_findings,
    outline_findings,
    place_findings,
    sampled,
    sheet_findings,
)
from neuspring.perception.frames import frames_of, gray, spread
from neuspring.perception.results import LiftedTracks, ShapePrior

SAME_GRAY = 6
"""Change of gray below which a pixel did not change."""
PAIRS = 16
"""How many pairs of frames are looked at for pixels that change their label alone."""
HANDS_INSIDE = 0.25
"""Part of the hands' pixels that lie in pieces enclosed by the object, from which they are its print."""
FLICKER = 0.08
"""Pixels that change their label and not their color, as part of object and hands, from which labels are noise."""
LAG, LOOKED = 3, 24
"""How many frames apart two are between which the picture changes, and how many such pairs are looked at."""
WIDTH, MOVED = 320, 12
"""Width, pixels, at which they are compared, and the change of a color value from which a pixel moves."""
RIM, BESIDE = 0.01, 0.075
"""Part of the width by which a mask may be too small, and beside an object within which motion belongs to it or to a hand."""
OUTSIDE = 0.25
"""Share of the moving pixels that lie in no mask. Right masks of real films and of synthetic scenes have more in at most 2 of 24
pairs; masks that lose half of the object, in 3 or more."""
STIRRED = 0.05
"""Part of the object's pixels that change where it moves."""
NEW, DARKER, TINT = 0.01, 0.05, 0.12
"""Part of the object's pixels that must look new; how much lighter, as a log ratio, a shadow may make a pixel, and by how much the
ratios of its three colors may differ."""
KEPT = 0.4
"""Share of what the object seems to cover newly that lies in its mask. Right masks of real films keep 0.52 to 0.99, and masks that
lose 80 % of it 0.2 or less. Of color alone: right masks of a real RGBD film, in which an arm comes near, keep 0.2 too."""
UNMARKED = (
    "Look there: a part of the object, or a hand that came in, lies in no mask. Mark it in that frame (`neuspring annotate`), and "
    "carry again. If neither moves there, ignore this."
)
COVERED = 0.15
"""Share of the object's moving pixels with a followed point nearby; 0.16 at least in the synthetic scenes."""
SPACING = 3.0
"""Nearby, as a multiple of the mean distance of points in frame 0."""
WRONG = ("background in the mask", "mask flickers", "hands too large", "hands inside the object", "labels are noise")
"""Findings of masks that cannot be right, by name: `perception.segment.verdict` decides what happens."""
TRACKS = 50
"""Points on the object in frame 0."""
FOLLOWED = 0.1
"""Share of the points of frame 0 that are still followed."""
OFTEN = 0.1
"""Share of the frames with fewer, from which that is a warning: a rope that turns away from one camera for two frames is none."""
VOLUME = 0.012
"""m^3 of a hull: a large plush animal has 5 liters."""
INVENTED = 0.8
"""Share of the surface that no camera saw; of a body seen from one side it is about two thirds."""
RISES = 0.05
"""Part of a body that is not laid onto the table, because it would lie too far behind. Two sloths that lie have up to 0.03."""
TRUSTED = 0.5
"""Share of motions that agree with their neighbors, of points that are seen in both frames; points that are lost are said apart."""
SEEN = 0.05
"""Share of the object's points that are seen in a frame."""
GRIP = 0.04
"""m from the object within which a controller can hold it."""
APART = 0.15
"""m between hand and object, at their nearest, from which there is no interaction to learn from."""
LOST = 0.1
"""Share of the object's points that are lost in a training frame, from which the others do not tell that it stands still."""
STILL = 0.005
"""m: motions smaller than this are noise."""
RESIZED = 1.8
"""Change of a hand's apparent size."""
FASTEST = 5.0
"""m/s: no hand that manipulates is faster."""
NODES = (30, 5000)
"""Structure points that can deform, and that a search can pay for."""


def mask_facts(capture: Capture, camera: str, labels: np.ndarray) -> dict[str, float]:
    """Shares and counts of labels [T, H, W]; `look_at_masks` says what they mean."""
    shown = shown_by(capture, camera, labels)
    frames, areas = shown.frames, shown.areas[:, shown.frames]
    return {
        "object_share": float((labels == OBJECT).mean()),
        "hand_share": float((labels == HANDS).mean()),
        "objects": float(shown.objects),
        "frames_without_object": float((areas[OBJECT] == 0).sum()),
        "frames_missing": float(len(labels) - len(frames)),
        "object_at_border": shown.bordered,
        "area_jumps": shown.steps,
        "hands_to_object": _median(areas[HANDS] / np.maximum(areas[OBJECT], 1.0)),
        "hands_inside": _median([_inside(labels[frame]) for frame in frames]),
        "flicker": _flicker(capture, camera, labels, frames),
        **_outside(capture, camera, labels),
    }


def shown_by(capture: Capture, camera: str, labels: np.ndarray) -> Shown:
    """Counts of labels [T, H, W], over the frames that the camera has."""
    shown = Shown(len(labels), (labels.shape[2], labels.shape[1]))
    for frame in frames_of(capture, camera):
        shown.see(frame, labels[frame])
    return shown


def _median(values: Sequence[float] | np.ndarray) -> float:
    """0 of none: a camera may have no frame."""
    return float(np.median(values)) if len(values) else 0.0


def _flicker(capture: Capture, camera: str, labels: np.ndarray, frames: np.ndarray) -> float:
    """Pixels that change their label and not their color from one frame to the next, as part of object and hands."""
    flips = total = 0
    pairs = list(pairwise(frames.tolist()))
    for here, there in spread(pairs, PAIRS) if pairs else []:
        still = cv2.blur(cv2.absdiff(gray(capture, camera, here), gray(capture, camera, there)), (5, 5)) < SAME_GRAY
        flips += int((still & (labels[here] != labels[there])).sum())
        total += int((labels[here] > 0).sum())
    return flips / max(total, 1)


@dataclass(frozen=True, eq=False)
class _Motion:
    """How the picture of a camera changes from a frame on, at WIDTH pixels."""

    frame: int
    moving: np.ndarray
    """[h, w] bool: what changes within LAG frames."""
    since: np.ndarray
    """[h, w] bool: what has changed plainly since frame 0."""
    shaded: np.ndarray
    """[h, w] bool: what looks as in frame 0 in a shadow."""
    labels: np.ndarray
    """[3, h, w]: of the frame, of that LAG later, and of frame 0."""


def _motions(capture: Capture, camera: str, labels: np.ndarray) -> Iterator[_Motion]:
    """At most LOOKED of them, evenly spread."""
    frames, view = frames_of(capture, camera), capture.cameras[camera]
    scale = min(1.0, WIDTH / view.width)
    size = round(scale * view.width), round(scale * view.height)

    def small(frame: int) -> np.ndarray:
        image = cv2.resize(np.ascontiguousarray(capture.color(camera, frame)), size, interpolation=cv2.INTER_AREA)
        return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)

    def change(one: np.ndarray, other: np.ndarray, least: float) -> np.ndarray:
        changed = (np.abs(one - other).max(axis=-1) > least).astype(np.uint8)
        return cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(bool)

    pairs = [(here, there) for here, there in zip(frames, frames[LAG:], strict=False) if there - here == LAG]
    first = small(frames[0]) if pairs else None
    for here, there in spread(pairs, LOOKED) if pairs else []:
        image = small(here)
        three = [cv2.resize(labels[k], size, interpolation=cv2.INTER_NEAREST) for k in (here, there, frames[0])]
        assert first is not None
        ratio = np.log((image + 8) / (first + 8))
        shaded = (ratio.max(axis=-1) < DARKER) & (np.ptp(ratio, axis=-1) < TINT)
        yield _Motion(here, change(image, small(there), MOVED), change(image, first, 2 * MOVED), shaded, np.stack(three))


def _grown(mask: np.ndarray, share: float) -> np.ndarray:
    """A mask [h, w] bool grown by a part of its width."""
    reach = round(share * mask.shape[1])
    return cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1,) * 2)).astype(bool)


def _outside(capture: Capture, camera: str, labels: np.ndarray) -> dict[str, float]:
    """Share of the times with motion at the object that no mask covers, and the first of them.

    And the share of training frames in which the picture is another where the object was in frame 0 and no hand is, or where it
    seems to be since. And how much of what seems newly covered since frame 0 lies in the object's mask: what changed where neither
    object nor hand was or is near, is no shadow, and touches the object.
    """
    outside, stirred, newly, looked = [], [], [], 0
    for motion in _motions(capture, camera, labels):
        both, begin, looked = motion.labels[:2], motion.labels[2] == OBJECT, looked + 1
        near = motion.moving & _grown((both == OBJECT).any(axis=0), BESIDE)
        bare = int((near & ~_grown(np.any(both, axis=0), RIM)).sum())
        if bare > max(OUTSIDE * near.sum(), RIM * (both[0] == OBJECT).sum()):
            outside.append(motion.frame)
        if (covered := _newly(motion))[1] > NEW * begin.sum():
            newly.append((motion.frame, *covered))
        if motion.frame < capture.train_end:
            own = motion.since & begin & ~_grown((motion.labels == HANDS).any(axis=0), RIM)
            stirred.append(own.sum() + covered[1] > STIRRED * max(begin.sum(), 1))
    if len(outside) < FEWEST_STEPS:
        outside = []
    first = {"first_outside": float(outside[0])} if outside else {}
    if len(newly) >= FEWEST_STEPS:
        first["newly_kept"] = sum(kept for _, kept, _ in newly) / sum(seen for *_, seen in newly)
        lost = [frame for frame, kept, seen in newly if kept < KEPT * seen]
        first |= {"first_newly_lost": float(lost[0])} if lost else {}
    return {"moves_outside": len(outside) / max(looked, 1), "object_moves": float(np.mean(stirred or [0])), **first}


def _newly(motion: _Motion) -> tuple[int, int]:
    """Pixels that the object seems to cover newly since frame 0: those in its mask, and all."""
    now, first = motion.labels[0], motion.labels[2]
    new = cv2.morphologyEx((motion.since & ~motion.shaded).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    new &= ~_grown((first > 0) | (now == HANDS), RIM)
    around = _grown((first == OBJECT) | (now == OBJECT), 2 * RIM)
    pieces = cv2.connectedComponents((new | around).astype(np.uint8))[1]
    new &= np.isin(pieces, np.unique(pieces[around]))
    return int((new & (now == OBJECT)).sum()), int(new.sum())


def _inside(labels: np.ndarray) -> float:
    """Part of the hands' pixels [H, W] in pieces whose surroundings are nearly all object."""
    hands = (labels == HANDS).astype(np.uint8)
    count, pieces, boxes, _ = cv2.connectedComponentsWithStats(hands)
    inside = 0
    for piece in range(1, count):
        own = (pieces == piece).astype(np.uint8)
        around = cv2.dilate(own, np.ones((5, 5), np.uint8)).astype(bool) & (own == 0)
        if around.any() and (labels[around] == OBJECT).mean() > 0.8:
            inside += int(boxes[piece, cv2.CC_STAT_AREA])
    return inside / max(int(hands.sum()), 1)


def look_at_masks(capture: Capture, camera: str, labels: np.ndarray, facts: Mapping[str, float]) -> list[Finding]:
    """Findings about labels [T, H, W] of one camera, with their `mask_facts`."""
    view, where = capture.cameras[camera], f"camera {camera}"
    found = mask_findings(camera, shown_by(capture, camera, labels))
    if capture.has_depth:
        samples = {
            frame: Sample(capture.depth(camera, frame), labels[frame])
            for frame in sorted(sampled(capture.frame_count))
            if capture.has(camera, frame)
        }
        found += [one for one in depth_findings(view, samples) if one.level != "note"]
        found += hand_findings(view, samples)
    else:
        found += outline_findings(f"camera {camera}, object", labels[0], capture.description.category)
    if facts["hands_inside"] > HANDS_INSIDE:
        value = f"{facts['hands_inside']:.0%} of the hands' pixels lie inside of the object"
        rule = f"at most {HANDS_INSIDE:.0%} are expected; its own colors are taken for hands"
        found.append(finding("hands inside the object", "warning", where, value, rule, REMEDY))
    if facts["flicker"] > FLICKER:
        value = f"{facts['flicker']:.0%} of the masks changes its label where the image does not change"
        found.append(finding("labels are noise", "warning", where, value, f"at most {FLICKER:.0%} is expected", REMEDY))
    if facts["moves_outside"] >= OFTEN:
        value = f"in {facts['moves_outside']:.0%} of the times that were looked at, first in frame {int(facts['first_outside'])}, "
        value += f"more than {OUTSIDE:.0%} of what moves at the object lies in no mask"
        found.append(
            finding("motion outside of the masks", "warning", where, value, f"less than {OFTEN:.0%} is expected", UNMARKED)
        )
    if not capture.has_depth and facts.get("newly_kept", 1.0) < KEPT:
        value = f"of what the object seems to cover newly since frame 0, its mask keeps {facts['newly_kept']:.0%}, "
        value += f"too little first in frame {int(facts['first_newly_lost'])}"
        rule = f"at least {KEPT:.0%} is expected"
        found.append(finding("newly covered parts lost", "warning", where, value, rule, UNMARKED))
    return found


def look_at_tracks(capture: Capture, camera: str, labels: np.ndarray, pixels: np.ndarray, visible: np.ndarray) -> list[Finding]:
    """Findings about tracks: pixels [T, Q, 2] and visible [T, Q], with the masks' labels [T, H, W]."""
    x, y = np.round(pixels[0]).astype(int).T
    own = labels[0][y, x] == OBJECT
    if not own.any():
        return []
    where, found = f"camera {camera}", []
    if own.sum() < TRACKS:
        value, rule = f"{own.sum()} points are followed on the object", f"at least {TRACKS} are expected"
        remedy = "Film from nearer by, or raise points of perception.track."
        found.append(finding("few tracks", "warning", where, value, rule, remedy))
    value, low = _few(visible[:, own], FOLLOWED, "followed")
    if low:
        level: Level = "warning" if len(low) >= OFTEN * len(visible) else "note"
        remedy = f"Look at tracks.png; end the capture before frame {low[0]}, use more light or shorter exposures, or cotracker3."
        found.append(finding("tracks lost", level, where, value, f"at least {FOLLOWED:.0%} are expected in every frame", remedy))
    shares = _covered(capture, camera, labels, pixels[:, own], visible[:, own])
    bare = [frame for frame, share in shares if share < COVERED]
    if not any(one.level == "warning" for one in found) and len(bare) >= max(FEWEST_STEPS, OFTEN * LOOKED):
        value = (
            f"in {len(bare)} of {LOOKED} frames that were looked at, first in frame {bare[0]}, the part of the object that moves "
        )
        value += f"has followed points on less than {COVERED:.0%} of it"
        rule = "points that stand still alone teach no motion"
        remedy = f"Look at tracks.png; end the capture before frame {bare[0]}, use more light or shorter exposures, or cotracker3."
        found.append(finding("tracks lost where it moves", "warning", where, value, rule, remedy))
    return found


def _covered(
    capture: Capture, camera: str, labels: np.ndarray, pixels: np.ndarray, visible: np.ndarray
) -> Iterator[tuple[int, float]]:
    """Frames in which a part of the object moves, and how much of that part has a followed point of [T, n, 2] nearby."""
    for motion in _motions(capture, camera, labels):
        body = motion.labels[0] == OBJECT
        own, scale = motion.moving & body, body.shape[1] / labels.shape[2]
        if own.sum() <= STIRRED * body.sum():
            continue
        spacing = scale * np.sqrt((labels[0] == OBJECT).sum() / visible.shape[1])
        empty = np.ones(body.shape, np.uint8)
        x, y = np.clip(
            np.round(scale * pixels[motion.frame, visible[motion.frame]]).astype(int), 0, np.array(body.shape[::-1]) - 1
        ).T
        empty[y, x] = 0
        away = cv2.distanceTransform(empty, cv2.DIST_L2, 5) if len(x) else np.full(body.shape, np.inf)
        yield motion.frame, float((away[own] <= max(SPACING * spacing, RIM * body.shape[1])).mean())


def _few(visible: np.ndarray, least: float, what: str) -> tuple[str, list[int]]:
    """What to say of the frames in which fewer points [T, n] are visible than a share, and these frames."""
    alive = visible.mean(axis=1)
    low = np.flatnonzero(alive < least).tolist()
    return f"{alive.min():.0%} of the object's points are {what} in frame {int(alive.argmin())}; few in {len(low)} frames", low


def look_at_lifted(lifted: LiftedTracks, prior: ShapePrior, up: float, image: ImageObservations | None = None) -> list[Finding]:
    """Findings about points in the world and the shape; `up` is +1 or -1. `image`: the evidence of color alone."""
    moving = _motion(lifted) if image is None else _in_image(image)
    filled = image is None and prior.backend.startswith("visual_hull")
    flat = sheet_findings("object in frame 0", lifted.cloud, up) if filled else []
    return [*place_findings("object in frame 0", [lifted.cloud], up), *flat, *_pose(lifted), *_shape(prior), *moving]


def look_at_observations(observations: Observations, moves: float = 0.0) -> list[Finding]:
    """Findings about what every method reads. Errors are what no method can work with.

    `moves`: the share of training frames in which the picture of the object changes, as masks know it.
    """
    where, nodes, scenario = "observations", observations.nodes, observations.scenario
    found = _hands(observations.controller_points, observations)
    if len(nodes) < NODES[0]:
        value, rule = f"{len(nodes)} structure points", f"at least {NODES[0]} are needed to deform"
        remedy = "Lower perception.sample.voxel, or give the object more pixels."
        found.append(finding("too few nodes", "error" if len(nodes) < 4 else "warning", where, value, rule, remedy))
    if len(nodes) > NODES[1]:
        value, rule = f"{len(nodes):,} structure points", f"more than {NODES[1]:,} make searches take hours"
        found.append(finding("many nodes", "note", where, value, rule, "perception.sample.nodes limits them."))
    image = observations.image
    if image is None:
        seen = observations.object_visibility[: scenario.train_end]
        moved = np.linalg.norm(observations.object_points[: scenario.train_end] - observations.object_points[0], axis=2)
    else:
        seen = image.visible[: scenario.train_end]
        moved = image.pixel_size * np.linalg.norm(image.pixels[: scenario.train_end] - image.pixels[0], axis=2)
    # Of the points that are seen in a frame, a tenth moves farther than this; the farthest frame counts.
    farthest = max(
        (float(np.quantile(row[shown], 0.9)) for row, shown in zip(moved, seen, strict=True) if shown.any()), default=0.0
    )
    # What is lost may have moved: neither is known then.
    lost = 1 - min((float(shown.mean()) for shown in seen), default=1.0)
    if farthest < STILL and (moves >= OFTEN or lost > LOST):
        value = f"points of the object move {1e3 * farthest:.1f} mm in the training frames, its picture changes in {moves:.0%} of "
        value += f"them, and up to {lost:.0%} of the points are lost"
        rule = "where it moves it is not followed"
        remedy = "Look at masks.png and tracks.png: mark what the masks lose, use more light or shorter exposures, or cotracker3."
        found.append(finding("object not followed", "warning", where, value, rule, remedy))
    elif farthest < STILL:
        value = f"the object moves {1e3 * farthest:.1f} mm in the training frames"
        rule = f"at least {1e3 * STILL:g} mm are needed to learn from; `static` cannot be beaten"
        found.append(finding("object stands still", "warning", where, value, rule, "Film an interaction, or move the split."))
    return found


def _pose(lifted: LiftedTracks) -> list[Finding]:
    """What was supposed of how a body lies or stands, where color alone shows it and the capture does not say it."""
    if not lifted.backend.startswith("color alone, body"):
        return []
    longest, across, raised = (lifted.facts[f"shape_{name}"] for name in ("longest", "across", "raised"))
    if lifted.backend != "color alone, body":
        value = f"{lifted.backend.rsplit(', ', 1)[1]}, as capture.json says; {raised:.0%} of it rises from what touches the table"
        return [finding("pose", "note", "shape", value, "thickness follows the width of the outline")]
    value = f"if it lies, it reaches {100 * longest:.0f} cm behind its nearest point and is {100 * across:.0f} cm wide"
    if raised > RISES:
        value += f", so {raised:.0%} of it is supposed to rise"
    rule = "one picture cannot say whether it lies or stands"
    remedy = 'Write "pose": "lying" or "standing" in capture.json.'
    return [finding("pose", "warning" if raised > RISES else "note", "shape", value, rule, remedy)]


def _shape(prior: ShapePrior) -> list[Finding]:
    found, volume, share = [], prior.facts.get("volume", 0.0), prior.facts.get("invented_share", 0.0)
    if volume > VOLUME:
        value, rule = f"{1e3 * volume:.1f} liters", f"at most {1e3 * VOLUME:g} liters are expected of a thing that hands hold"
        remedy = "Masks that show sleeves, table or other things make it large: look at masks.png and lifted.png."
        found.append(finding("volume of the hull", "warning", "shape", value, rule, remedy))
    if share > INVENTED or prior.facts.get("cameras") == 1:
        level, rule = ("warning", f"at most {INVENTED:.0%} are expected") if share > INVENTED else ("note", "the rest was measured")
        value = f"no camera saw {share:.0%} of the surface ({prior.backend})"
        remedy = "Add a camera from the other side, or a mesh (perception.shape.backend: mesh)."
        found.append(finding("invented surface", level, "shape", value, rule, remedy))  # type: ignore[arg-type]
    return found


def _motion(lifted: LiftedTracks) -> list[Finding]:
    found, where = [], "lifted tracks"
    both = lifted.object_visibility[:-1] & lifted.object_visibility[1:]
    share = float(lifted.object_motion_valid[:-1].sum() / max(int(both.sum()), 1))
    remedy = "Look at tracks.png and lifted.png; perception.lift has neighborhood."
    if both.any() and share < TRUSTED:
        value, rule = f"{share:.0%} of the object's motions are trusted", f"at least {TRUSTED:.0%} are expected"
        found.append(finding("motion not trusted", "warning", where, value, rule, remedy))
    if "grip_elsewhere" in lifted.facts:
        frame = int(lifted.facts["grip_elsewhere"])
        value = f"in frame {frame} a hand comes back to another part of the object"
        rule = "springs of hands are made for their place in frame 0, so nothing moves the twin there"
        found.append(finding("grip elsewhere", "warning", "controllers", value, rule, f"End the capture before frame {frame}."))
    if count := int(lifted.facts.get("stray_hand_frames", 0)):
        first = int(lifted.facts["stray_hand_first"])
        value = f"in {count} training frames, first in frame {first}, a hand is on the object that no controller follows"
        rule = "what that hand does to the object reaches no twin: controllers are points of the hands of frame 0"
        remedy_here = f"End the capture before frame {first}, or begin it when all hands are in view (make-capture --frames)."
        level: Level = "warning" if count >= OFTEN * len(lifted.object_points) else "note"
        found.append(finding("hand without controllers", level, "controllers", value, rule, remedy_here))
    value, low = _few(lifted.object_visibility, SEEN, "seen")
    if low:
        rule = f"at least {SEEN:.0%} are expected in every frame"
        found.append(finding("points lost", "warning", where, value, rule, f"End the capture before frame {low[0]}. {remedy}"))
    return found


def _in_image(image: ImageObservations) -> list[Finding]:
    """Points of the object that are lost in the image, and hands that were not followed."""
    found = []
    value, low = _few(image.visible[: len(image.inside)], SEEN, "seen")
    if low:
        rule = f"at least {SEEN:.0%} are expected in every training frame; silhouettes alone say where the object is in the others"
        found.append(finding("points lost", "warning", "tracks", value, rule, "Look at tracks.png."))
    if image.hands and (image.hand_sizes.max() > RESIZED or image.hand_sizes.min() < 1 / RESIZED):
        value = f"a hand appears {image.hand_sizes.min():.2f} to {image.hand_sizes.max():.2f} times as large as in frame 0"
        rule = f"a hand at arm's length changes by less than {RESIZED:g} times; it was not followed well"
        found.append(finding("size of hands", "warning", "hands", value, rule, "Look at hands.png, and mark the hands anew."))
    return found


def _hands(controllers: np.ndarray, observations: Observations) -> list[Finding]:
    """Controllers [T, C, 3] that hold nothing, never come near, stand still, or are faster than hands are."""
    where, found, rate = "controllers", [], observations.scenario.frame_rate
    remedy = "Masks may take something else for a hand: look at masks.png; perception.lift has grip and grip_reach."
    # Distances [T, C] of controllers from the nearest point of the object that is seen; in frame 0 from all nodes.
    apart = np.full(controllers.shape[:2], np.inf)
    for frame, own in enumerate(controllers):
        shown = observations.object_points[frame, observations.object_visibility[frame]]
        points = observations.nodes if frame == 0 else shown
        if len(points):
            apart[frame] = cKDTree(points).query(own)[0]
    nearest = apart.min(axis=1)
    if nearest.min() > APART:
        value = f"the hand is never nearer to the object than {100 * nearest.min():.0f} cm"
        rule = f"it must come within {100 * APART:g} cm to move it"
        return [finding("hand far from the object", "error", where, value, rule, remedy)]
    holding, count = int((apart[0] <= GRIP).sum()), len(apart[0])
    if not holding:
        near = f"{100 * GRIP:g} cm; the nearest is {100 * nearest[0]:.0f} cm away"
        value = f"in frame 0 none of {count} has a point of the object within {near}"
        rule = "springs of hands are made in frame 0, and would span the air"
        found.append(finding("controllers hold nothing", "warning", where, value, rule, "Begin the capture at the grip."))
    elif 2 * holding < count:
        value = f"{count - holding} of {count} have no point of the object within {100 * GRIP:g} cm in frame 0"
        rule = "only those that are near hold it"
        found.append(
            finding("most controllers hold nothing", "note", where, value, rule, "perception.lift.grip: patch takes near ones.")
        )
    holds = observations.controller_valid
    if len(holds) and (gone := int((~holds).any(axis=0).sum())):
        value = f"{gone} of {count} let go, first in frame {int(np.flatnonzero(~holds.all(axis=1))[0])}"
        if (again := (holds[1:] & ~holds[:-1]).any(axis=1)).any():
            value += f", and some take hold again, first in frame {int(again.argmax()) + 1}"
        rule = "while they do not hold, their springs do not act (perception.lift.release)"
        found.append(finding("hands let go", "note", where, value, rule, "Is that what was filmed?"))
    if (moved := float(np.linalg.norm(controllers - controllers[0], axis=2).max())) < STILL:
        value, rule = f"they move {1e3 * moved:.1f} mm", f"at least {1e3 * STILL:g} mm are expected of hands that move an object"
        found.append(finding("controllers stand still", "warning", where, value, rule, remedy))
    speed = rate * np.median(np.linalg.norm(np.diff(controllers, axis=0), axis=2), axis=1)
    if speed.max(initial=0.0) > FASTEST:
        value = f"{speed.max():.0f} m/s between frames {int(speed.argmax())} and {int(speed.argmax()) + 1}"
        rule = f"hands are slower than {FASTEST:g} m/s"
        remedy = f"frame_rate ({rate:g}/s) or depth_unit of capture.json may be wrong, or a hand's tracks jump."
        found.append(finding("controllers too fast", "warning", where, value, rule, remedy))
    return found
