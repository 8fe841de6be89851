"""Settings of synthetic captures and of perception, the steps from raw RGBD video to observations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from neuspring.config.types import STRICT, Count, NonNegative, Positive, Range


@dataclass(frozen=True, kw_only=True)
class Synthetic:
    """Synthetic captures: finite elements seen by a ray caster through a model of a depth sensor."""

    __pydantic_config__ = STRICT
    size: Literal["tiny", "demo", "full"] = "demo"
    """Images of 120 x 68, 424 x 240 or 848 x 480 pixels, meshes to match."""
    frames: Annotated[int, Field(ge=5)] | None = None
    """Keep only the first frames of a scene; null keeps all."""
    cameras: Annotated[int, Field(ge=1, le=3)] = 3
    """How many cameras film it."""
    sensor: Literal["model", "clean"] = "model"
    """Depth with noise, dropouts and holes, or only quantised."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Of the sensor's noise; the scenario's name enters too."""


@dataclass(frozen=True, kw_only=True)
class OpenCvSegmentation:
    """Segmentation by height and colour against the table, hands by their colour."""

    __pydantic_config__ = STRICT
    height: Positive = 0.012
    """m above the table from which a pixel is foreground whatever its colour; below, its colour decides."""
    hand_hue: Range = (35.0, 70.0)
    """Hue of hands or gloves in Lab, degrees (atan2(b, a)); skin by default."""
    hand_chroma: Range = (9.0, 36.0)
    """Their chroma in Lab."""
    smoothing: Positive = 1.5
    """Width, pixels, over which the decision between hand and object is averaged."""
    smallest: NonNegative = 0.0004
    """Pieces below this part of the image join what surrounds them."""


@dataclass(frozen=True, kw_only=True)
class OpenCvTracking:
    """Lucas-Kanade or DIS flow with a forward-backward check."""

    __pydantic_config__ = STRICT
    method: Literal["lucas_kanade", "dis"] = "lucas_kanade"
    """Pyramidal Lucas-Kanade per point, or dense DIS flow."""
    points: Count = 5000
    """Most pixels followed per camera, random ones of the masks of frame 0."""
    window: Annotated[int, Field(ge=5)] = 9
    """Side of the Lucas-Kanade window, pixels. A large one averages over what deforms and over the background."""
    levels: Annotated[int, Field(ge=0)] = 3
    """Of the image pyramid, beside the image itself."""
    forward_backward: Positive = 0.5
    """Pixels by which a point may miss its start when followed there and back."""
    reacquire: bool = True
    """Look for lost points again by their appearance in frame 0."""
    likeness: Annotated[float, Field(gt=-1, lt=1)] = 0.85
    """Least correlation of the patch of a point found again with its patch of frame 0."""


@dataclass(frozen=True, kw_only=True)
class GroundedSam2:
    """GroundingDINO and SAM 2, through `transformers` (extra `perception`); defaults are those of the released processing."""

    __pydantic_config__ = STRICT
    detector: str = "IDEA-Research/grounding-dino-tiny"
    """Name on the Hugging Face hub, or a folder."""
    video_model: str = "facebook/sam2.1-hiera-large"
    """Name on the Hugging Face hub, or a folder."""
    prompt: str | None = None
    """Words for the object; null: the capture's category."""
    hand_prompt: str = "hand"
    """Words for hands."""
    box_threshold: Annotated[float, Field(gt=0, lt=1)] = 0.35
    """Least score of a box."""
    text_threshold: Annotated[float, Field(gt=0, lt=1)] = 0.25
    """Least score of a word for a box."""
    download: bool = False
    """Fetch weights that are not in the cache."""


@dataclass(frozen=True, kw_only=True)
class CoTracker3:
    """CoTracker3, online, from torch.hub."""

    __pydantic_config__ = STRICT
    points: Count = 5000
    """Most pixels followed per camera, random ones of the masks of frame 0."""
    download: bool = False
    """Fetch code and weights that are not in the cache (mind their licence)."""


@dataclass(frozen=True, kw_only=True)
class Lift:
    """Pixels to points in the world, and which of them are trusted; defaults are those of the released processing."""

    __pydantic_config__ = STRICT
    depth_range: Range = (0.2, 1.5)
    """m along the optical axis; other depth is not used."""
    depth_window: Count = 3
    """Side of the window, pixels, whose median depth inside the mask a track gets; 1 as released."""
    whole_pixels: bool = False
    """Lift the nearest whole pixel of a track, as released."""
    neighbourhood: Positive = 0.01
    """m, in which masks and motions look for neighbours."""
    outlier_neighbours: NonNegative = 40.0
    """A masked pixel needs more neighbours than this, at a focal length of 430 pixels."""
    least_neighbours: Count = 5
    """A motion needs so many neighbours, itself included, ..."""
    agreement: Positive = 0.005
    """... of which half move alike within this distance, m."""
    controllers: Count = 30
    """Most controller points."""
    least_controllers: Count = 30
    """Fewer are an error."""
    controller_gaps: Literal["none", "rigid"] = "none"
    """none, as released: controllers are visible throughout. rigid: gaps are filled by the rigid motion of the hand."""
    controller_share: Annotated[float, Field(gt=0, le=1)] = 0.6
    """With controller_gaps: rigid, the part of the frames in which a controller must be seen."""
    sequential_motion_filter: bool = False
    """Judge motions in the order of the points, each by those not dropped before, as released."""
    coordinate_outliers: bool = False
    """Drop masked pixels that share any one coordinate with an outlier, as released."""
    mirrored_principal_point: bool = False
    """Measure x from W - cx, as the processing did before July 2025."""


@dataclass(frozen=True, kw_only=True)
class ShapePriorSettings:
    """What the cameras do not see of the object in frame 0."""

    __pydantic_config__ = STRICT
    backend: Literal["auto", "none", "visual_hull", "mesh", "truth"] = "auto"
    """auto: none for `thin` categories, else visual_hull. none: only what was seen. visual_hull: voxels carved by masks and depth.
    mesh: a file, aligned to what was seen. truth: the surface of a synthetic capture, to measure what perception costs."""
    thin: tuple[str, ...] = ("cloth", "package")
    """Categories that need no prior."""
    voxel: Positive = 0.003
    """m."""
    margin: Positive = 0.02
    """m around the cloud of frame 0 that is carved."""
    tolerance: Positive = 0.004
    """m by which measured depth may lie behind a voxel before it is carved."""
    smoothing: Positive = 1.0
    """Width, voxels, by which the hull is smoothed."""
    mesh: str | None = None
    """File for backend: mesh."""
    bend: bool = True
    """Move the mesh, once placed, to where its visible part was seen."""
    bend_reach: Positive = 0.02
    """m by which a visible vertex may miss the cloud to be moved onto it."""


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Structure points; defaults are those of the released processing."""

    __pydantic_config__ = STRICT
    voxel: Positive = 0.005
    """m: one point each."""
    surface: Count = 1024
    """Points drawn on the prior's surface."""
    interior: Count = 10000
    """Points drawn in its bounding box; those inside are kept."""


@dataclass(frozen=True, kw_only=True)
class Segmentation:
    """Which pixels show the object and the hands."""

    __pydantic_config__ = STRICT
    backend: Literal["given", "opencv", "grounded_sam2"] = "given"
    """given: the capture's masks. opencv: height and colour. grounded_sam2: GroundingDINO and SAM 2 (extra `perception`)."""
    opencv: OpenCvSegmentation = field(default_factory=OpenCvSegmentation)
    """See [perception.segment.opencv](#perceptionsegmentopencv)."""
    grounded_sam2: GroundedSam2 = field(default_factory=GroundedSam2)
    """See [perception.segment.grounded_sam2](#perceptionsegmentgrounded_sam2)."""


@dataclass(frozen=True, kw_only=True)
class PointTracking:
    """Where the pixels of frame 0 go."""

    __pydantic_config__ = STRICT
    backend: Literal["opencv", "cotracker3", "truth"] = "opencv"
    """opencv: Lucas-Kanade or DIS flow. cotracker3: the online CoTracker3 of torch.hub. truth: exact, of synthetic captures, to
    measure what perception costs; as many points as opencv."""
    opencv: OpenCvTracking = field(default_factory=OpenCvTracking)
    """See [perception.track.opencv](#perceptiontrackopencv)."""
    cotracker3: CoTracker3 = field(default_factory=CoTracker3)
    """See [perception.track.cotracker3](#perceptiontrackcotracker3)."""


@dataclass(frozen=True, kw_only=True)
class Perception:
    """Raw RGBD video to observations."""

    __pydantic_config__ = STRICT
    segment: Segmentation = field(default_factory=Segmentation)
    """See [perception.segment](#perceptionsegment)."""
    track: PointTracking = field(default_factory=PointTracking)
    """See [perception.track](#perceptiontrack)."""
    lift: Lift = field(default_factory=Lift)
    """See [perception.lift](#perceptionlift)."""
    shape: ShapePriorSettings = field(default_factory=ShapePriorSettings)
    """See [perception.shape](#perceptionshape)."""
    sample: Sampling = field(default_factory=Sampling)
    """See [perception.sample](#perceptionsample)."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Of the pixels that are followed and the points that are sampled."""
