"""Segmentation by GroundingDINO and SAM 2, through `transformers` (extra `perception`).

A text prompt finds boxes in the first frame, boxes start masks, and SAM 2 carries the masks through the video. As in PhysTwin's
released processing, the prompt names object and hand, boxes need a minimum score, and each detection that is not a hand is the
object. With a user's annotations (`carry`), SAM 2 starts from them and needs no prompt.

Weights are read from the Hugging Face cache; they are downloaded only if `download` is true.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neuspring.config.perception import GroundedSam2
from neuspring.core.errors import InputError
from neuspring.core.extras import needed
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture
from neuspring.data.frames import frames_of
from neuspring.perception.film import CameraFilm, Carried, Progress, doubt_of, over_capture
from neuspring.perception.marks import Mark, drawn

DETECTOR, VIDEO_MODEL = "IDEA-Research/grounding-dino-tiny", "facebook/sam2.1-hiera-large"
"""Models on the Hugging Face hub, as in the released processing."""
BOX_SCORE, WORD_SCORE = 0.35, 0.25
"""Lowest scores of a box and of its words, as released."""
UNSURE = 0.5
"""Mean probability of the other label at borders that alone gives a doubt of 63 %."""


@dataclass(frozen=True)
class Models:
    """The two networks with their processors."""

    detector: Any
    detector_processor: Any
    video: Any
    video_processor: Any


@dataclass(frozen=True)
class Detection:
    """A box in the first frame."""

    box: tuple[float, float, float, float]
    """x0, y0, x1, y1, pixels."""
    words: str
    score: float


def segment(capture: Capture, camera: str, settings: GroundedSam2, device: str, models: Models | None = None) -> np.ndarray:
    """Labels [T, H, W] uint8. Raises InputError if weights are missing, or if the prompt finds no object or no hand."""
    models = models or load(settings, device)
    frames = frames_of(capture, camera)
    images = [capture.color(camera, frame) for frame in frames]
    prompt = capture.description.category
    detections = detect(images[0], prompt, models, device)
    is_hand = ["hand" in detection.words.replace(".", " ").split() for detection in detections]
    if all(is_hand) or not any(is_hand):
        missing = "hand" if detections and not any(is_hand) else "object"
        where = f"{capture.folder}, camera {camera}, frame {frames[0]}"
        rule = f"the prompts {prompt!r} and 'hand' must find an object and a hand"
        remedy = f"Set other words for the object as category of {CAPTURE}, or run `neuspring annotate {capture.folder}`."
        raise InputError(where, rule, f"no {missing} among {[detection.words for detection in detections]}", remedy)
    labels = np.zeros((capture.frame_count, *images[0].shape[:2]), dtype=np.uint8)
    boxes = {"obj_ids": list(range(len(detections))), "input_boxes": [[list(detection.box) for detection in detections]]}
    for index, logits in propagate(images, {0: boxes}, models, device).items():
        # Hands come last because they occlude the object.
        labels[frames[index]][(logits[np.logical_not(is_hand)] > 0).any(axis=0)] = OBJECT
        labels[frames[index]][(logits[is_hand] > 0).any(axis=0)] = HANDS
    return labels


def carry(
    capture: Capture,
    camera: str,
    marks: Sequence[Mark],
    progress: Progress | None,
    settings: GroundedSam2,
    device: str,
    models: Models | None = None,
) -> Carried:
    """Labels [T, H, W] and doubt [T] from annotations of a few frames, which become prompts (`prompt_of`) carried both ways.

    Doubt combines SAM 2's uncertainty at borders and jumps of areas. Raises InputError if weights are missing, or if annotations
    do not fit the capture.
    """
    if not any(mark.label == "object" for mark in marks):
        labels = sorted({mark.label for mark in marks})
        raise InputError(f"annotations of camera {camera}", "an object must be annotated in at least one frame", labels)

    def work(film: CameraFilm, own: list[Mark]) -> Carried:
        networks = models or load(settings, device, words=False)
        images = [film.color(index) for index in range(film.count)]
        size = images[0].shape[:2]
        labels, unsure = np.zeros((film.count, *size), np.uint8), np.zeros((film.count, 2))
        # Hands come last because they occlude the object.
        for column, label in enumerate((OBJECT, HANDS)):
            frames = sorted({mark.frame for mark in own if mark.value == label})
            prompts = {at: prompt_of([mark for mark in own if (mark.frame, mark.value) == (at, label)], size) for at in frames}
            carried = propagate(images, prompts, networks, device, back=True) if prompts else {}
            for index, (logits,) in carried.items():
                labels[index][logits > 0] = label
                near = np.abs(logits) < np.quantile(np.abs(logits[logits > 0]), 0.2) if (logits > 0).any() else logits > 0
                unsure[index, column] = float((1 / (1 + np.exp(np.abs(logits[near])))).mean()) if near.any() else 0.0
                if progress is not None:
                    progress(column * film.count + index + 1, 2 * film.count)
        return Carried(labels, doubt_of(labels, (unsure.max(axis=1) / UNSURE) ** 2))

    return over_capture(capture, camera, marks, work)


def prompt_of(marks: Sequence[Mark], size: tuple[int, int]) -> dict[str, Any]:
    """Prompt for SAM 2 from the annotations of one label in a frame of a size (height, width).

    Polygons become a mask. Without polygons, the rectangle around all boxes becomes a box, and clicks and scribbles become
    points.
    """
    if polygons := [drawn(mark, size, 1.0, grown=0) for mark in marks if mark.kind == "polygon"]:
        return {"obj_ids": [0], "input_masks": [np.any(polygons, axis=0)]}
    prompt: dict[str, Any] = {"obj_ids": [0]}
    if corners := [point for mark in marks if mark.kind == "box" for point in mark.points]:
        prompt["input_boxes"] = [[[*np.min(corners, axis=0).tolist(), *np.max(corners, axis=0).tolist()]]]
    if points := [list(point) for mark in marks if mark.kind != "box" for point in mark.points]:
        prompt |= {"input_points": [[points]], "input_labels": [[[1] * len(points)]]}
    return prompt


def propagate(
    images: list[np.ndarray], prompts: Mapping[int, Mapping[str, Any]], models: Models, device: str, *, back: bool = False
) -> dict[int, np.ndarray]:
    """Logits [n, H, W] of n items by frame, carried forward from the first prompted frame, and backward with `back`.

    `prompts` by frame are those of SAM 2: `obj_ids` (0 to n - 1), and `input_boxes` or `input_masks`.
    """
    import torch

    processor, size, logits = models.video_processor, list(images[0].shape[:2]), {}
    with torch.inference_mode():
        session = processor.init_video_session(video=images, inference_device=device)
        for frame, prompt in sorted(prompts.items()):
            processor.add_inputs_to_inference_session(session, frame_idx=frame, **prompt)
            models.video(inference_session=session, frame_idx=frame)
        for reverse in (False, True) if back else (False,):
            for output in models.video.propagate_in_video_iterator(session, start_frame_idx=min(prompts), reverse=reverse):
                scaled = processor.post_process_masks([output.pred_masks], original_sizes=[size], binarize=False)[0]
                logits[output.frame_idx] = scaled[:, 0].float().cpu().numpy()
    return logits


def load(settings: GroundedSam2, device: str, *, words: bool = True) -> Models:
    """Load the pretrained networks; the detector only with `words`. Raises InputError that names missing weights."""
    transformers = needed("transformers")
    local = not settings.download
    # Reads only safetensors, because a pickle can run code.
    weights = {"local_files_only": local, "use_safetensors": True}
    detector: Any = transformers.GroundingDinoForObjectDetection
    video_model: Any = transformers.Sam2VideoModel
    try:
        return Models(
            detector.from_pretrained(DETECTOR, **weights).to(device).eval() if words else None,
            transformers.AutoProcessor.from_pretrained(DETECTOR, local_files_only=local) if words else None,
            video_model.from_pretrained(VIDEO_MODEL, **weights).to(device).eval(),
            transformers.Sam2VideoProcessor.from_pretrained(VIDEO_MODEL, local_files_only=local),
        )
    except OSError as error:
        wanted = f"{DETECTOR} and {VIDEO_MODEL}" if words else VIDEO_MODEL
        rule = f"weights of {wanted} must be in the Hugging Face cache"
        remedy = "Set perception.segment.grounded_sam2.download: true once, or copy the cache from another machine."
        raise InputError("perception.segment.grounded_sam2", rule, str(error).splitlines()[0], remedy) from error


def detect(image: np.ndarray, prompt: str, models: Models, device: str) -> list[Detection]:
    """Boxes that the prompt finds in an RGB image, best first."""
    import torch

    words = f"{prompt}. hand."
    inputs = models.detector_processor(images=image, text=words.lower(), return_tensors="pt").to(device)
    with torch.inference_mode():
        outputs = models.detector(**inputs)
    result = models.detector_processor.post_process_grounded_object_detection(
        outputs, inputs["input_ids"], threshold=BOX_SCORE, text_threshold=WORD_SCORE, target_sizes=[image.shape[:2]]
    )[0]
    rows = zip(result["boxes"].tolist(), result["text_labels"], result["scores"].tolist(), strict=True)
    detections = [Detection(tuple(box), str(text), float(score)) for box, text, score in rows]
    return sorted(detections, key=lambda detection: -detection.score)
