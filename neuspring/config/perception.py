"""Settings of perception: the steps from raw RGBD video to observations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, NonNegative, Positive, SettingsSection


@dataclass(frozen=True, kw_only=True)
class GroundedSam2(SettingsSection):
    """GroundingDINO and SAM 2, through `transformers` (extra `perception`): the capture's category is the prompt."""

    download: bool = False
    """Download of weights that are not in the cache."""


@dataclass(frozen=True, kw_only=True)
class Lift(SettingsSection):
    """Pixels to points in the world, and which of them are trusted; defaults are those of the released processing."""

    neighborhood: Positive = 0.01
    """Distance, m, within which masks and motions look for neighbors; more for images of few pixels."""
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
    release: Positive | None = None
    """Distance, m, between hand and object beyond which a hand has let go: its springs do not act. If it comes near the same part
    of the object again, it takes hold again. null: hands hold to the end, as released."""


@dataclass(frozen=True, kw_only=True)
class ShapePriorSettings(SettingsSection):
    """The parts of the object in frame 0 that no camera sees."""

    backend: Literal["auto", "none", "visual_hull", "mesh", "truth"] = "auto"
    """Shape of what was not seen; auto: none for cloth and packages, else visual_hull. none: only what was seen. visual_hull:
    voxels carved by masks and depth. mesh: a file, aligned to what was seen. truth: the surface of a synthetic capture, to measure
    what perception costs."""
    back: Literal["none", "symmetry"] = "symmetry"
    """End of the hull where one camera alone shows the object in frame 0, so that its back is invented. symmetry: where the seen
    surface is mirrored about the surface that the silhouette's rim spans. none: at the table, or a margin behind what was seen."""
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
class Segmentation(SettingsSection):
    """Pixels that show the object and the hands."""

    backend: str = "given"
    """Source of masks: the capture's, height and color, marks of a user, or networks. opencv: height and color; of a capture with
    marks.json, marks. marks: the capture's marks.json, carried through the video. grounded_sam2: GroundingDINO and SAM 2 (extra
    `perception`)."""
    grounded_sam2: GroundedSam2 = field(default_factory=GroundedSam2)


@dataclass(frozen=True, kw_only=True)
class PointTracking(SettingsSection):
    """The way of the pixels of frame 0."""

    backend: str = "opencv"
    """Tracker: Lucas-Kanade, a network, or the truth of a synthetic capture. cotracker3: the online CoTracker3 of torch.hub.
    truth: exact tracks of a synthetic capture, to measure what perception costs."""
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
