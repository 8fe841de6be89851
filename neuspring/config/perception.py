"""Settings of perception: the steps from raw RGBD video to observations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.core.section import Count, NonNegative, Positive, SettingsSection


@dataclass(frozen=True, kw_only=True)
class GroundedSam2(SettingsSection):
    """GroundingDINO and SAM 2 from `transformers` (extra `perception`); the prompt is the capture's category."""

    download: bool = False
    """Download missing weights."""


@dataclass(frozen=True, kw_only=True)
class Lift(SettingsSection):
    """Pixels to 3D points, and outlier rejection. Defaults: the released processing."""

    neighborhood: Positive = 0.01
    """Radius, m, in which outlier tests of masks and motions look for neighbors; increase it for small images."""
    least_controllers: Count = 30
    """Minimum number of controllers; fewer are an error."""
    controller_gaps: Literal["none", "rigid"] = "none"
    """Gaps in controller tracks: not allowed (none, as released), or filled by the rigid motion of the hand (rigid)."""
    controller_share: Annotated[float, Field(gt=0, le=1)] = 0.6
    """Fraction of the frames in which a controller must be visible, with `controller_gaps: rigid`."""
    grip: Literal["points", "patch"] = "points"
    """Controllers: spread over hand and forearm (points, as released), or a rigid patch near the object (patch). points: each
    controller follows its own track. patch: the controllers cover the part of each hand that is near the object in frame 0, and
    move rigidly with the hand, so a grasp keeps direction and roll."""
    release: Positive | None = None
    """Distance between hand and object, m, beyond which a hand has released the object; null: never, as released. The springs of
    a released hand do not act. A hand that returns to the same part of the object grasps it again."""


@dataclass(frozen=True, kw_only=True)
class ShapePriorSettings(SettingsSection):
    """Shape prior: the object's unobserved parts in frame 0."""

    backend: Literal["auto", "none", "visual_hull", "mesh", "truth"] = "auto"
    """Source of the unobserved shape; auto: none for cloth and packages, else visual_hull. none: observed points only.
    visual_hull: voxels carved by masks and depth. mesh: a file, aligned to the observed points. truth: the surface of a synthetic
    capture, to measure the error of perception."""
    back: Literal["none", "symmetry"] = "symmetry"
    """Back of the hull if only one camera shows the object in frame 0. symmetry: the observed surface, mirrored about the
    surface that the silhouette's rim spans. none: the hull ends at the table, or a margin behind the observed surface."""
    mesh: str | None = None
    """Mesh file for `backend: mesh`."""


@dataclass(frozen=True, kw_only=True)
class Sampling(SettingsSection):
    """Nodes of the twin. Defaults: the released processing."""

    voxel: Positive = 0.005
    """Voxel size, m; each voxel contains at most one node."""
    nodes: Count | None = None
    """Maximum number of nodes: the voxel size is increased until it is met; null: no maximum. Thus a rope is sampled more finely
    than a plush animal at the same cost."""


@dataclass(frozen=True, kw_only=True)
class Segmentation(SettingsSection):
    """Masks of the object and the hands."""

    backend: str = "given"
    """Source of masks: the capture (given), height and color (opencv), annotations (marks), or networks (grounded_sam2). opencv
    uses the annotations of a capture that has them. marks: marks.json of the capture, propagated through the video.
    grounded_sam2: GroundingDINO and SAM 2 (extra `perception`)."""
    grounded_sam2: GroundedSam2 = field(default_factory=GroundedSam2)


@dataclass(frozen=True, kw_only=True)
class PointTracking(SettingsSection):
    """Tracks of the pixels of frame 0."""

    backend: str = "opencv"
    """Tracker: Lucas-Kanade (opencv), a network (cotracker3), or the truth of a synthetic capture. cotracker3: the online
    CoTracker3 of torch.hub. truth: exact tracks, to measure the error of perception."""
    rim: NonNegative = 0.0
    """Tolerance outside the mask, pixels, beyond which `opencv` loses a point. Masks are inexact at tips and corners."""
    download: bool = False
    """Download missing code and weights of `cotracker3`. Check their license."""


@dataclass(frozen=True, kw_only=True)
class Perception(SettingsSection):
    """Raw video to observations."""

    segment: Segmentation = field(default_factory=Segmentation)
    track: PointTracking = field(default_factory=PointTracking)
    lift: Lift = field(default_factory=Lift)
    shape: ShapePriorSettings = field(default_factory=ShapePriorSettings)
    sample: Sampling = field(default_factory=Sampling)
