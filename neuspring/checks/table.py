"""All checks of the core: what is measured, the range that is fine, what a departure does to results, and the next step.

`rows` is the table of neuspring/data/README.md. Limits were chosen so that the synthetic scenes and the real recordings of the
tests pass.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import inf

from neuspring.checks import masks, moving, objects, observed, perceived, rig, space, timing
from neuspring.checks.fitted import SHARE_AT_BOUND, at_bound, at_range
from neuspring.core.checks import Check
from neuspring.data.camera import FAR, NEAR
from neuspring.data.capture import HANDS, OBJECT

ANNOTATE = "Annotate object and hands in some frames (`neuspring annotate`), or choose another perception.segment.backend."
SHEET = "Look at contact_sheet.jpg."
LOOK_AT_UNITS = "Look at the unit of depth and poses (meters), and at the mask of frame 0 in contact_sheet.jpg."
LOOK_AT_TRACKS = "Look at tracks.png; end the capture earlier, use more light or shorter exposures, or cotracker3."
DEPTH = ("depth",)

# fmt: off
checks = (
    # Masks of one camera
    Check("no object in frame 0", "masks", lambda shown: masks.first_area(shown, OBJECT), (1, inf), "warning",
          "pixels of the object in frame 0", ANNOTATE, unit="pixels", effect="shape and points begin there"),
    Check("no hand in frame 0", "masks", lambda shown: masks.first_area(shown, HANDS), (1, inf), "warning",
          "pixels of hands in frame 0", "Begin the capture when a hand is in view, or annotate it.", unit="pixels",
          effect="controllers begin in frame 0"),
    Check("object missing", "masks", masks.missing, (0, 0), "warning",
          "frames that show almost nothing of the object", ANNOTATE, unit="frames", effect="its points are invisible there"),
    Check("background in the mask", "masks", lambda shown: shown.bordered, (0, 0.1), "warning",
          "fraction of the image's border that is object", ANNOTATE, unit="%",
          effect="the mask contains the table, a sleeve or a person"),
    Check("labels exchanged", "masks", masks.exchanged, (0, 0.5), "warning",
          "fraction of its frames in which the object reaches the image border, and hands do not",
          f"If labels are exchanged, write {OBJECT} for the object and {HANDS} for hands.", unit="%",
          effect="arms enter at the border, an object does not"),
    Check("mask flickers", "masks", lambda shown: shown.steps, (0, masks.STEPS_SHARE), "warning",
          f"fraction of frames in which the object's area changes {masks.AREA_STEP:g}-fold", ANNOTATE, unit="%",
          effect="tracks and silhouettes are wrong"),
    Check("mask jumps", "masks", masks.jumps, (0, 2), "warning",
          "ratio of the object's areas in neighboring frames", ANNOTATE, effect="no object grows that fast"),
    Check("hands inside the object", "segmentation", lambda facts: facts["hands_inside"], (0, 0.25), "warning",
          "fraction of the hands' pixels inside of the object", ANNOTATE, unit="%", effect="its own colors are taken for hands"),
    Check("labels are noise", "segmentation", lambda facts: facts["flicker"], (0, 0.08), "warning",
          "fraction of the masks that changes its label where the image does not change", ANNOTATE, unit="%",
          effect="tracks begin on the background"),
    Check("motion outside of the masks", "segmentation", masks.outside, (0, masks.OFTEN), "warning",
          "fraction of the times at which something moves beside the object and is in no mask", ANNOTATE, unit="%",
          effect="a part of the object, or a hand, has no mask"),
    # Object and hands of one camera
    Check("depth holes", "object and hands", objects.holes, (0, 0.4), "warning",
          "fraction of the object's pixels without depth",
          "Record from farther than the sensor's least distance, without shine and direct sun.", unit="%",
          effect="little of it is lifted", needs=DEPTH),
    Check("hands too large", "object and hands", objects.hand_area, (0, 0.12), "warning",
          "area of the hands", "Mark sleeves, torso and table to be ignored (`neuspring annotate`).", unit="m²",
          effect="controllers are points of sleeves or a torso", needs=DEPTH),
    Check("hand far from the object", "hands", objects.hand_gap, (0, objects.HAND_REACH), "warning",
          "least distance of hands from the object", "Look for a wrong object or hand in contact_sheet.jpg.", unit="m",
          effect="hands that do not touch move nothing", needs=DEPTH),
    Check("constant grips", "grips", objects.constant_grips, None, "note",
          f"hands within {100 * objects.HAND_REACH:g} cm of the object, by frames: {{text}}. A twin is best learned from one "
          "constant grip{cut}", title=""),
    Check("size of the object", "object", objects.size, None, "note", "{text}.",
          f"Is that what was recorded? If not: {LOOK_AT_UNITS}"),
    Check("object below the table", "object", objects.lowest, (-0.02, inf), "warning",
          "lowest height of the object above the table", LOOK_AT_UNITS, unit="m", effect="the ground pushes it up in the twin"),
    Check("depth unit", "depths", lambda median: median, (NEAR, FAR), "error",
          "median depth", "State the unit of the images, depth_unit in m per count.", unit="m",
          effect="the twin has another scale", needs=DEPTH),
    # Cameras
    Check("table elsewhere", "rig", rig.off_table, (0, rig.TABLE_OFF), "warning",
          "distance of the table from z = 0, tilt included",
          f"{SHEET} Usual causes: unit, world-to-camera poses, axes of OpenGL, y up, another order of the cameras.", unit="m",
          effect="ground contact is at z = 0", needs=DEPTH),
    Check("view of the table", "rig", rig.view_of_table, (NEAR, 3.0), "warning",
          "distance of the table z = 0 in the center of the image",
          f"{SHEET} Usual causes: up, world-to-camera poses, axes of OpenGL, a unit that is not meters.", unit="m",
          effect="the camera does not look at the table from above"),
    Check("principal point", "rig", rig.off_center, (0, 0.1), "warning",
          "distance of the principal point from the center of the image", "State the intrinsics of these images.", unit="%",
          effect="intrinsics of another image size bend all that is lifted"),
    Check("depth along the axis", "rig", rig.flatness, (-inf, 0.2), "warning",
          "additional pixels on one plane if depth is taken for the distance to the camera",
          "Convert it: z = r / sqrt(1 + ((x - cx) / fx)^2 + ((y - cy) / fy)^2).", unit="%",
          effect="the distance to the camera instead of depth along the axis bends a flat table", needs=DEPTH),
    Check("views disagree", "rig", rig.disagreement, (0, 0.12), "warning",
          "points above the table of one camera that the other looked through",
          f"{SHEET} A pose, the order of cameras, a lens or a moment is wrong.", unit="%",
          effect="one object becomes two", needs=DEPTH),
    # Time
    Check("out of step", "streams", timing.out_of_step, (-timing.HALF, timing.HALF), "error",
          "frames by which one stream is late, by what moves", "{next}", unit="frames",
          effect="hands and object move at different times", title="time"),
    Check("masks of another camera", "mask fit", timing.unlike, (0.5, inf), "warning",
          "correlation of motion in masks and images, relative to the images that they fit best",
          f"{SHEET} Give each camera its own masks.", effect="masks show another camera or recording"),
    Check("repeated images", "repeats", timing.repeats, (0, 0), "warning",
          "images that are equal to the one before",
          "Record at the sensor's own rate, or keep one of each, as with make-capture --frames 0-300/2.", unit="images",
          effect="motion stands still and jumps, and images equal to the bit are not scored"),
    # Points from frame to frame
    Check("lost points as numbers", "moving", lambda one, _: moving.lost(one), (0, 0), "error",
          "times at which a point has a repeated or impossible position", "{1}.", unit="times",
          effect="a point that is not seen has no position", title=""),
    Check("held value", "moving", lambda one, _: moving.held(one), (0, 0), "warning",
          "times at which a point stays equal to the bit, and then steps", "Did the stream stop? {1}.", unit="times",
          effect="a gap was filled with the last value", title=""),
    Check("labels swapped", "moving", lambda one, _: moving.swapped(one), (0, 0), "warning",
          "times at which a point has the position of another", moving.ORDER, unit="times",
          effect="points are mixed up", title=""),
    Check("step far beyond the others", "moving", lambda one, _: moving.stepped(one), (0, 0), "warning",
          f"steps {moving.STEP:g} times as large as those around", "Another label, a lost marker, or a reflex? {1}.", unit="steps",
          effect="a controller or marker jumps", title=""),
    # Points in space
    Check("unit", "points", space.far, (0, FAR), "error", "largest coordinate", "{next}", unit="m",
          effect="coordinates are not in meters", title="points"),
    Check("off the table", "points", space.off_table, (-0.02, inf), "warning", "lowest height above the table z = 0",
          "If y is up, write (x, -z, y) in all files; if -z is up, state --up -z; without a table state --no-table.", unit="m",
          effect="the ground pushes the object up", title="points"),
    Check("points off the body", "points on nodes", space.off_body, (0, objects.HAND_REACH), "warning",
          "largest distance of annotated points from the nodes in frame 0", "Are points and nodes of one recording and world?",
          unit="m", effect="points follow no node", title=""),
    Check("hand far from the nodes", "holding", space.reach, (0, objects.HAND_REACH), "error",
          "least distance of controllers that hold from the nodes in training frames",
          "Are hands and nodes of one recording and world?", unit="m", effect="hands that do not touch move nothing",
          title="points"),
    # Results of perception
    Check("points lost", "visible points", perceived.followed, (0.05, inf), "warning",
          "least fraction of the object's points that are visible in a frame", LOOK_AT_TRACKS, unit="%",
          effect="motion is not seen there"),
    Check("motion not trusted", "lifted tracks", perceived.trusted, (0.5, inf), "warning",
          "fraction of the object's motions that agree with their neighbors", LOOK_AT_TRACKS, unit="%",
          effect="the twin learns from wrong motion"),
    Check("grip elsewhere", "lifted tracks", perceived.grip_elsewhere, None, "warning",
          "in frame {value} a hand comes back to another part of the object; springs of hands are made for their position in frame "
          "0, so nothing moves the twin there.", "End the capture before frame {value}."),
    # Observations
    Check("hand far from the object", "observations", observed.gap, (0, observed.NO_INTERACTION), "error",
          "least distance of a controller from the object", "Look at masks.png: something else may be taken for a hand.", unit="m",
          effect="there is no interaction to learn from"),
    Check("controllers hold nothing", "observations", observed.first_gap, (0, observed.GRIP), "warning",
          "least distance of a controller from the object in frame 0", "Begin the capture at the grip.", unit="m",
          effect="springs of hands are made in frame 0, and would span the air"),
    Check("controllers stand still", "observations", observed.motion_of_hands, (0.005, inf), "warning",
          "farthest motion of a controller", "Look at masks.png: something else may be taken for a hand.", unit="m",
          effect="nothing moves the twin"),
    Check("controllers too fast", "observations", observed.speed_of_hands, (0, 5), "warning",
          "largest median speed of the controllers", "Look at frame_rate and depth_unit, and at the tracks of hands.", unit="m/s",
          effect="forces grow with the square of a wrong rate"),
    Check("not plumb", "observations", observed.leaning, (0, 1.5), "warning",
          "angle of an object that hangs at rest to the vertical through its hands",
          "make-capture --plumb turns points in space; of cameras state another pose of the table.", unit="degrees",
          effect="gravity pulls the twin aside"),
    Check("number of nodes", "observations", observed.node_count, (30, 5000), "warning",
          "structure points", "Set perception.sample.voxel or perception.sample.nodes.", unit="nodes",
          effect="few nodes do not deform, and many make searches take hours"),
    Check("object stands still", "observations", observed.motion_of_object, (0.005, inf), "warning",
          "farthest motion of the object in the training frames",
          "Record an interaction, or move the split; if it moves, look at masks.png and tracks.png.", unit="m",
          effect="there is nothing to learn, or the motion is not followed"),
    # Fits
    Check("springs at their bound", "fit", at_bound, (0, SHARE_AT_BOUND), "warning",
          "fraction of the springs at the bound of their stiffness (fit.output_bound)",
          "Raise fit.output_bound of this method, and compare.", unit="%",
          effect="a wider bound may predict better"),
    Check("springs at the end of the range", "fit", at_range, (0, SHARE_AT_BOUND), "warning",
          "fraction of the springs at an end of the range of stiffness (fit.stiffness_range)",
          "Widen it: add `--config 'fit={{stiffness_range: [{least}, {more}]}}'` to the command.", unit="%",
          effect="a wider range may predict better"),
)


def rows(listed: Iterable[Check] = checks) -> str:
    """The checks as a Markdown table."""
    lines = ["| check | measured | expected | level | effect |", "|---|---|---|---|---|"]
    for one in listed:
        if one.effect:
            lines.append(f"| {one.name} | {one.sentence} | {one.expected()} | {one.level} | {one.effect} |")
    return "\n".join(lines) + "\n"
