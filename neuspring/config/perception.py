"""Settings of perception: the steps from raw RGBD video to observations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, NonNegative, Positive, Range, SettingsSection


@dataclass(frozen=True, kw_only=True)
class OpenCvSegmentation(SettingsSection):
    """Segmentation by height and color against the table; hands by their color."""

    height: Positive = 0.012
    """Height above the table, m, from which a pixel is foreground whatever its color; below, its color decides."""
    hand_hue: Range = (35.0, 70.0)
    """Hue of hands or gloves in Lab, degrees (atan2(b, a)); the default is skin."""
    hand_chroma: Range = (9.0, 36.0)
    """Chroma of hands or gloves in Lab."""


@dataclass(frozen=True, kw_only=True)
class MarksSegmentation(SettingsSection):
    """Segmentation from the marks of a user (`marks.json` of the capture), carried through the video."""

    background: bool = True
    """Learning of the color of every pixel of the background; for a camera that stands still."""
    scale: Annotated[float, Field(gt=0, le=4)] = 1.0
    """Size of the images that are worked on, as a multiple of the camera's; 2 helps ropes of a few pixels."""


@dataclass(frozen=True, kw_only=True)
class GroundedSam2(SettingsSection):
    """GroundingDINO and SAM 2, through `transformers` (extra `perception`); defaults are those of the released processing."""

    prompt: str | None = None
    """Words for the object; null: the capture's category."""
    download: bool = False
    """Download of weights that are not in the cache."""


@dataclass(frozen=True, kw_only=True)
class Lift(SettingsSection):
    """Pixels to points in the world, and which of them are trusted; defaults are those of the released processing."""

    depth_range: Range = (0.2, 1.5)
    """Depth that is used, m along the optical axis."""
    neighborhood: Positive = 0.01
    """Distance, m, within which masks and motions look for neighbors."""
    outlier_neighbors: NonNegative = 40.0
    """Number of neighbors that a masked pixel must exceed, at a focal length of 430 pixels."""
    controllers: Count = 30
    """Largest number of controller points."""
    least_controllers: Count = 30
    """Smallest number of controller points; fewer are an error."""
    controller_gaps: Literal["none", "rigid"] = "none"
    """Gaps of controllers: none, as released, or filled by the rigid motion of the hand."""
    controller_share: Annotated[float, Field(gt=0, le=1)] = 0.6
    """Part of the frames in which a controller must be seen, with `controller_gaps: rigid`."""
    grip: Literal["points", "patch"] = "points"
    """Places of controllers: spread over hand and forearm, as released, or a rigid patch near the object. points, as released:
    spread over hand and forearm, each where its track is. patch: spread over the part of each hand that is near the object in
    frame 0, and moving rigidly with the hand: a grip keeps direction and roll."""
    grip_reach: Positive = 0.03
    """Distance by which controllers of `grip: patch` may lie farther from the object than a hand's nearest point in frame 0, m."""
    release: Positive | None = None
    """Distance, m, between hand and object beyond which a hand has let go: its springs do not act. If it comes near the same part
    of the object again, it takes hold again. null: hands hold to the end, as released."""
    released: bool = False
    """Lifting as in the released processing. A track is lifted at its nearest whole pixel with its own depth, motions are judged in
    the order of the points, and a masked pixel that shares any one coordinate with an outlier is dropped."""
    mirrored_principal_point: bool = False
    """Measurement of x from W - cx, as the released processing did before July 2025."""


@dataclass(frozen=True, kw_only=True)
class ShapePriorSettings(SettingsSection):
    """The parts of the object in frame 0 that no camera sees."""

    backend: Literal["auto", "none", "visual_hull", "mesh", "truth"] = "auto"
    """Shape of what was not seen; auto: none for cloth and packages, else visual_hull. none: only what was seen. visual_hull:
    voxels carved by masks and depth. mesh: a file, aligned to what was seen. truth: the surface of a synthetic capture, to measure
    what perception costs."""
    back: Literal["none", "symmetry", "fraction"] = "symmetry"
    """End of the hull where one camera alone shows the object in frame 0, so that its back is invented. fraction: behind the seen
    surface by 1.2 of the silhouette's local width, rounded to its edge. symmetry: where the seen surface is mirrored about the
    surface that the silhouette's rim spans. none: at the table, or a margin behind what was seen."""
    mesh: str | None = None
    """File of the mesh for `backend: mesh`."""


@dataclass(frozen=True, kw_only=True)
class Sampling(SettingsSection):
    """Structure points; defaults are those of the released processing."""

    voxel: Positive = 0.005
    """Side of a voxel, m; one structure point is kept in each."""
    nodes: Count | None = None
    """Most structure points, for which the voxel grows from `voxel` on; null: `voxel` as it is. So a rope is sampled finer than a
    plush animal at the same cost."""


@dataclass(frozen=True, kw_only=True)
class ColorSettings(SettingsSection):
    """Captures without depth (`depth: none`): the object of frame 0 on the table, hands and silhouettes in the image."""

    flat: tuple[str, ...] = ("cloth",)
    """Categories of sheets: every pixel lies on the table."""
    round: tuple[str, ...] = ("rope",)
    """Categories of ropes: as thick as they are wide."""


@dataclass(frozen=True, kw_only=True)
class Segmentation(SettingsSection):
    """Pixels that show the object and the hands."""

    backend: str = "given"
    """Source of masks: the capture's, height and color, marks of a user, or networks. opencv: height and color; of a capture with
    marks.json, marks. marks: the capture's marks.json, carried through the video. grounded_sam2: GroundingDINO and SAM 2 (extra
    `perception`)."""
    marks: MarksSegmentation = field(default_factory=MarksSegmentation)
    opencv: OpenCvSegmentation = field(default_factory=OpenCvSegmentation)
    grounded_sam2: GroundedSam2 = field(default_factory=GroundedSam2)
    verdict: Literal["warn", "error"] = "warn"
    """Consequence of masks that cannot be right: printed and recorded (warn), or a failure of the step (error)."""


@dataclass(frozen=True, kw_only=True)
class PointTracking(SettingsSection):
    """The way of the pixels of frame 0."""

    backend: str = "opencv"
    """Tracker: Lucas-Kanade, a network, or the truth of a synthetic capture. cotracker3: the online CoTracker3 of torch.hub.
    truth: exact tracks of a synthetic capture, to measure what perception costs."""
    points: Count = 5000
    """Largest number of pixels that are followed per camera, drawn at random from the masks of frame 0."""
    rim: NonNegative = 0.0
    """Distance outside of its mask at which a point of `opencv` is lost, pixels: masks are off by pixels at tips and corners."""
    download: bool = False
    """Download of code and weights of `cotracker3` that are not in the cache. Mind their license."""


@dataclass(frozen=True, kw_only=True)
class Perception(SettingsSection):
    """Raw video to observations."""

    segment: Segmentation = field(default_factory=Segmentation)
    track: PointTracking = field(default_factory=PointTracking)
    lift: Lift = field(default_factory=Lift)
    shape: ShapePriorSettings = field(default_factory=ShapePriorSettings)
    sample: Sampling = field(default_factory=Sampling)
    color: ColorSettings = field(default_factory=ColorSettings)
