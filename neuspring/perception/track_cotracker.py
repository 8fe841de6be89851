"""Dense tracking by the online model of CoTracker3 from torch.hub; queries are points of frame 0.

Code and weights belong to Meta, under a license of their own (non-commercial at the time of writing); this project contains
neither. They are read from the torch.hub cache, and downloaded only if `download` is true.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuspring.config.perception import PointTracking
from neuspring.core.errors import InputError
from neuspring.data.capture import Capture
from neuspring.data.frames import frames_of
from neuspring.perception.track_opencv import Followed, choose

WEIGHTS = "scaled_online.pth"
"""Checkpoint of the online predictor."""
WEIGHTS_URL = f"https://huggingface.co/facebook/cotracker3/resolve/main/{WEIGHTS}"


def track(capture: Capture, camera: str, labels: np.ndarray, settings: PointTracking, device: str, model: Any = None) -> Followed:
    """Track up to MOST_TRACKED pixels of the masks `labels` [T, H, W]; none if frame 0 shows neither object nor hands.

    `model` has the interface of CoTracker3's online predictor. The first call has is_first_step and the queries [1, Q, 3] (frame,
    x, y). Then each call, every `step` frames, has the latest 2 * step frames [1, t, 3, H, W], 0 to 255, and returns tracks [1,
    t, Q, 2] and visibility [1, t, Q] of all frames so far. Raises InputError if the model cannot be loaded.
    """
    start = choose(labels[0])
    result = Followed.starting_at(start, capture.frame_count)
    if not len(start):
        return result
    model = (load(settings) if model is None else model).to(device)
    frames = frames_of(capture, camera)
    video = torch.from_numpy(np.stack([capture.color(camera, frame) for frame in frames])).permute(0, 3, 1, 2)[None]
    queries = torch.from_numpy(np.concatenate([np.zeros((len(start), 1)), start], axis=1)[None]).float().to(device)
    positions, seen = _windows(model, video, queries, device)
    for k, frame in enumerate(frames):
        result.pixels[frame:], result.visible[frame] = positions[k], seen[k]
    result.pixels[0], result.visible[0] = start, True
    return result


def _windows(model: Any, video: torch.Tensor, queries: torch.Tensor, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Tracks [t, Q, 2] and visibility [t, Q] of all frames of the video."""
    step, count = int(model.step), video.shape[1]
    # Pads the last window with copies of the last frame; their results are dropped.
    padded = int(np.ceil(max(count, 2 * step) / step)) * step
    video = torch.cat([video, video[:, -1:].expand(-1, padded - count, -1, -1, -1)], dim=1) if padded > count else video
    with torch.inference_mode():
        model(video_chunk=video[:, : 2 * step].float().to(device), is_first_step=True, queries=queries)
        for first in range(0, padded - step, step):
            tracks, visible = model(video_chunk=video[:, first : first + 2 * step].float().to(device))
    return tracks[0, :count].cpu().numpy(), visible[0, :count].cpu().numpy().astype(bool)


def load(settings: PointTracking) -> Any:
    """Load the online predictor from torch.hub. Raises InputError if it is not cached and `download` is false."""
    hub = Path(torch.hub.get_dir())
    copies = sorted(hub.glob("facebookresearch_co-tracker_*"))
    if not (copies and (hub / "checkpoints" / WEIGHTS).is_file()) and not settings.download:
        rule = f"CoTracker3's code and checkpoints/{WEIGHTS} must be in the torch.hub cache"
        remedy = "Read its license and set perception.track.download: true once, or use the backend opencv."
        raise InputError("perception.track.backend", rule, f"not both in {hub}", remedy)
    # The hub's own loader would unpickle arbitrary objects; this reads only tensors.
    if copies:
        predictor: Any = torch.hub.load(str(copies[-1]), "cotracker3_online", source="local", pretrained=False)
    else:
        predictor = torch.hub.load("facebookresearch/co-tracker", "cotracker3_online", trust_repo=True, pretrained=False)
    predictor.model.load_state_dict(torch.hub.load_state_dict_from_url(WEIGHTS_URL, map_location="cpu", weights_only=True))
    return predictor
