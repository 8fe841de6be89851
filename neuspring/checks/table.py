"""All checks of the core: the measured value, its accepted range, the effect on results outside of it, and the next step.

`rows` returns the checks as a Markdown table. The limits accept the synthetic scenes and the real recordings of the tests.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import inf

from neuspring.checks import masks, moving, objects, observed, perceived, rig, space, timing
from neuspring.checks.fitted import SHARE_AT_BOUND, at_bound, at_range
from neuspring.core.checks import Check
from neuspring.data.camera import FAR, NEAR
from neuspring.data.capture import HANDS, OBJECT

ANNOTATE = "Annotate object and hands in some frames (`neuspring annotate`), or select another perception.segment.backend."
CHECK_UNITS = "Check the unit of depth and poses (m), and the mask of frame 0 in contact_sheet.jpg."
CHECK_TRACKS = "Check tracks.png; end the capture earlier or use cotracker3. For real cameras, use more light or short exposures."
CHECK_MASKS = "Check masks.png: another object may be labeled as a hand."
DEPTH = ("depth",)

# fmt: off
checks = (
    # Masks of one camera
    Check("no object in frame 0", "masks", lambda shown: masks.first_area(shown, OBJECT), (1, inf), "warning",
          "object pixels in frame 0", ANNOTATE, unit="pixels", effect="shape and tracks start from frame 0"),
    Check("no hand in frame 0", "masks", lambda shown: masks.first_area(shown, HANDS), (1, inf), "warning",
          "hand pixels in frame 0", "Start the capture when a hand is visible, or annotate the hand.", unit="pixels",
          effect="controllers start from frame 0"),
    Check("object missing", "masks", masks.missing, (0, 0), "warning",
          "frames with almost no object pixels", ANNOTATE, unit="frames", effect="the object is not observed there"),
    Check("background in the mask", "masks", lambda shown: shown.bordered, (0, 0.1), "warning",
          "fraction of the image border that is labeled as object", ANNOTATE, unit="%",
          effect="the mask may contain the table, a sleeve or a person"),
    Check("labels exchanged", "masks", masks.exchanged, (0, 0.5), "warning",
          "fraction of frames in which the object reaches the image border, while hands do not",
          f"If they are, write {OBJECT} for the object and {HANDS} for hands.", unit="%",
          effect="object and hands may be exchanged, because arms usually enter at the border"),
    Check("mask flickers", "masks", lambda shown: shown.steps, (0, masks.STEPS_SHARE), "warning",
          f"fraction of frames in which the object's area changes by a factor above {masks.AREA_STEP:g}", ANNOTATE, unit="%",
          effect="tracks and silhouettes become wrong"),
    Check("mask jumps", "masks", masks.jumps, (0, 2), "warning",
          "largest ratio of the object's areas in two neighboring frames", ANNOTATE, effect="one of the two masks may be wrong"),
    Check("hands inside the object", "segmentation", lambda facts: facts["hands_inside"], (0, 0.25), "warning",
          "fraction of hand pixels that are surrounded by the object", ANNOTATE, unit="%",
          effect="parts of the object may be labeled as hands"),
    Check("labels are noise", "segmentation", lambda facts: facts["flicker"], (0, 0.08), "warning",
          "fraction of mask pixels whose label changes although the image does not", ANNOTATE, unit="%",
          effect="tracks may start on the background"),
    Check("motion outside of the masks", "segmentation", masks.outside, (0, masks.OFTEN), "warning",
          "fraction of the compared frames with motion next to the object but outside of the masks", ANNOTATE, unit="%",
          effect="the masks may miss a part of the object or a hand"),
    # Object and hands of one camera
    Check("depth holes", "object and hands", objects.holes, (0, 0.4), "warning",
          "fraction of object pixels without depth",
          "If a sensor recorded it, keep its minimum distance and avoid reflections and direct sun.", unit="%",
          effect="only a small part of the object is lifted to 3D", needs=DEPTH),
    Check("hands too large", "object and hands", objects.hand_area, (0, 0.12), "warning",
          "area of the hands", "Annotate sleeves, torso and table as ignored (`neuspring annotate`).", unit="m²",
          effect="controllers may be points of sleeves or a torso", needs=DEPTH),
    Check("hand far from the object", "hands", objects.hand_gap, (0, objects.HAND_REACH), "warning",
          "smallest distance between hands and object", "Check the masks in contact_sheet.jpg.", unit="m",
          effect="hands that do not touch the object do not move it", needs=DEPTH),
    Check("constant grips", "grips", objects.constant_grips, None, "note",
          f"hands within {100 * objects.HAND_REACH:g} cm of the object in frames {{text}}. A constant number fits best{{cut}}",
          title=""),
    Check("size of the object", "object", objects.size, None, "note", "{text}.", f"If this is wrong: {CHECK_UNITS}"),
    Check("object below the table", "object", objects.lowest, (-0.02, inf), "warning",
          "lowest height of the object above the table", CHECK_UNITS, unit="m", effect="the ground pushes the twin up"),
    Check("depth unit", "depths", lambda median: median, (NEAR, FAR), "error",
          "median depth", "Set depth_unit to the m per count of the depth images.", unit="m",
          effect="the twin gets a wrong scale", needs=DEPTH),
    # Cameras
    Check("table elsewhere", "rig", rig.off_table, (0, rig.TABLE_OFF), "warning",
          "distance of the table from z = 0, tilt included",
          "Check contact_sheet.jpg for a wrong unit, world-to-camera poses, OpenGL axes, y up, or exchanged cameras.", unit="m",
          effect="the twin's ground is at z = 0, not at the table", needs=DEPTH),
    Check("view of the table", "rig", rig.view_of_table, (NEAR, 3.0), "warning",
          "distance from the camera to z = 0 along the image center",
          "Check contact_sheet.jpg for a wrong `up`, world-to-camera poses, OpenGL axes, or a unit other than m.", unit="m",
          effect="the camera may not look at the table from above"),
    Check("principal point", "rig", rig.off_center, (0, 0.1), "warning",
          "distance of the principal point from the image center", "Enter the intrinsics of these images.", unit="%",
          effect="intrinsics of another image size distort all 3D points"),
    Check("depth along the axis", "rig", rig.flatness, (-inf, 0.2), "warning",
          "additional pixels on one plane if depth is treated as the distance to the camera",
          "If it is that distance, convert it: z = r / sqrt(1 + ((x - cx) / fx)^2 + ((y - cy) / fy)^2).", unit="%",
          effect="such depth bends flat surfaces", needs=DEPTH),
    Check("views disagree", "rig", rig.disagreement, (0, 0.12), "warning",
          "points above the table of one camera that the other camera looks through",
          "Check contact_sheet.jpg for a wrong pose, camera order, lens model or synchronization.", unit="%",
          effect="the object may be reconstructed twice", needs=DEPTH),
    # Time
    Check("out of step", "streams", timing.out_of_step, (-timing.HALF, timing.HALF), "error",
          "delay between two streams, measured by their motion", "{next}", unit="frames",
          effect="hands and object move at different times", title="time"),
    Check("masks of another camera", "mask fit", timing.unlike, (0.5, inf), "warning",
          "correlation of mask motion with this camera's images, relative to the best camera",
          "Check contact_sheet.jpg, and give each camera its own masks.",
          effect="the masks may be of another camera or recording"),
    Check("repeated images", "repeats", timing.repeats, (0, 0), "warning",
          "images that equal the previous image",
          "Record at the sensor's frame rate, or drop the copies, for example with make-capture --frames 0-300/2.", unit="images",
          effect="motion stops and jumps, and equal images are not scored"),
    # Points from frame to frame
    Check("lost points as numbers", "moving", lambda one, _: moving.lost(one), (0, 0), "error",
          "times at which a point has a repeated or impossible position", "{1}.", unit="times",
          effect="an unseen point must not have a position", title=""),
    Check("held value", "moving", lambda one, _: moving.held(one), (0, 0), "warning",
          "times at which a point keeps exactly the same position and then jumps", "Check whether the stream stopped. {1}.",
          unit="times", effect="a gap may be filled with the last value", title=""),
    Check("labels swapped", "moving", lambda one, _: moving.swapped(one), (0, 0), "warning",
          "times at which a point has the position of another point", moving.ORDER, unit="times",
          effect="tracks mix several points", title=""),
    Check("step far beyond the others", "moving", lambda one, _: moving.stepped(one), (0, 0), "warning",
          f"steps more than {moving.STEP:g} times as large as neighboring steps",
          "Check for exchanged labels, lost markers and reflections. {1}.", unit="steps",
          effect="a controller or marker jumps", title=""),
    # Points in space
    Check("unit", "points", space.far, (0, FAR), "error", "largest coordinate", "{next}", unit="m",
          effect="the coordinates may not be in meters", title="points"),
    Check("off the table", "points", space.off_table, (-0.02, inf), "warning", "lowest height above the table z = 0",
          "If y is up, write (x, -z, y) in all files. If -z is up, pass --up -z. Without a table, pass --no-table.", unit="m",
          effect="the ground pushes the object up", title="points"),
    Check("points off the body", "points on nodes", space.off_body, (0, objects.HAND_REACH), "warning",
          "largest distance between annotated points and nodes in frame 0",
          "Check that points and nodes are of the same recording and coordinate system.", unit="m",
          effect="distant points do not move with the object", title=""),
    Check("hand far from the nodes", "holding", space.reach, (0, objects.HAND_REACH), "error",
          "smallest distance between grasping controllers and nodes in training frames",
          "Check that hands and nodes are of the same recording and coordinate system.", unit="m",
          effect="hands that do not touch the object do not move it", title="points"),
    # Results of perception
    Check("points lost", "visible points", perceived.followed, (0.05, inf), "warning",
          "smallest fraction of object points that are visible in a frame", CHECK_TRACKS, unit="%",
          effect="the motion there is not observed"),
    Check("motion not trusted", "lifted tracks", perceived.trusted, (0.5, inf), "warning",
          "fraction of object points that move like their neighbors", CHECK_TRACKS, unit="%",
          effect="the twin may learn wrong motion"),
    Check("grip elsewhere", "lifted tracks", perceived.grip_elsewhere, None, "warning",
          "in frame {value}, a hand grasps another part of the object; its springs are those of frame 0, so it moves nothing.",
          "End the capture before frame {value}."),
    # Observations
    Check("hand far from the object", "observations", observed.gap, (0, observed.NO_INTERACTION), "error",
          "smallest distance between controllers and object", CHECK_MASKS, unit="m",
          effect="there is no interaction to learn from"),
    Check("controllers hold nothing", "observations", observed.first_gap, (0, observed.GRIP), "warning",
          "smallest distance between controllers and object in frame 0", "Start the capture at the grasp.", unit="m",
          effect="springs of controllers are created in frame 0 and would be too long"),
    Check("controllers stand still", "observations", observed.motion_of_hands, (0.005, inf), "warning",
          "largest displacement of a controller", CHECK_MASKS, unit="m",
          effect="nothing moves the twin"),
    Check("controllers too fast", "observations", observed.speed_of_hands, (0, 5), "warning",
          "largest median speed of the controllers", "Check frame_rate, depth_unit and the tracks of hands.", unit="m/s",
          effect="a wrong frame rate changes forces by its square"),
    Check("not plumb", "observations", observed.leaning, (0, 1.5), "warning",
          "angle between the vertical and an object that hangs at rest",
          "For points in space, use make-capture --plumb. For cameras, correct the pose of the table.", unit="degrees",
          effect="gravity pulls the twin sideways"),
    Check("number of nodes", "observations", observed.node_count, (30, 5000), "warning",
          "nodes of the object", "Set perception.sample.voxel or perception.sample.nodes.", unit="nodes",
          effect="few nodes hardly deform, and many nodes make searches take hours"),
    Check("object stands still", "observations", observed.motion_of_object, (0.005, inf), "warning",
          "largest displacement of the object in training frames",
          "If it moves, check masks.png and tracks.png. Otherwise, record an interaction or move the split.", unit="m",
          effect="there is no motion to learn from, or tracks miss it"),
    # Fits
    Check("springs at their bound", "fit", at_bound, (0, SHARE_AT_BOUND), "warning",
          "fraction of springs at the bound of their stiffness (fit.output_bound)",
          "Increase fit.output_bound of this method, and compare.", unit="%",
          effect="a wider bound may predict better"),
    Check("springs at the end of the range", "fit", at_range, (0, SHARE_AT_BOUND), "warning",
          "fraction of springs at an end of the stiffness range (fit.stiffness_range)",
          "Widen it: add `--config 'fit={{stiffness_range: [{least}, {more}]}}'` to the command.", unit="%",
          effect="a wider range may predict better"),
)


def rows(listed: Iterable[Check] = checks) -> str:
    """The checks as a Markdown table."""
    lines = ["| check | measured | expected | level | effect |", "|---|---|---|---|---|"]
    for check in listed:
        if check.effect:
            lines.append(f"| {check.name} | {check.sentence} | {check.expected()} | {check.level} | {check.effect} |")
    return "\n".join(lines) + "\n"
