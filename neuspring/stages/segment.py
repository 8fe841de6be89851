"""Stage `segment`: one camera of a capture -> masks of object and hands."""

from __future__ import annotations

import dataclasses

from neuspring.config import Config
from neuspring.core.records import Recorder
from neuspring.data.capture import Capture
from neuspring.perception.backends import BACKENDS, backend_modules, segmentation, segmentation_keys
from neuspring.stages.stage import Rows, Written, stage


def _settled(rows: Rows) -> Config:
    """The configuration with backend `given` for processed data, which contain masks."""
    if rows.source.films:
        return rows.config
    perception = rows.config.perception
    given = dataclasses.replace(perception.segment, backend="given")
    return dataclasses.replace(rows.config, perception=dataclasses.replace(perception, segment=given))


@stage(
    output="{scenario}/perception/{camera}/masks.json",
    rule="perceive",
    when=lambda rows: rows.source.films or rows.images,
    reads=lambda settings, given: segmentation_keys(settings.perception.segment.backend),
    code=lambda settings, given: backend_modules("segment", settings.perception.segment.backend),
    gpu=lambda settings: BACKENDS["segment"][settings.perception.segment.backend].gpu,
    memory_mb=8000,
    minutes=120,
    settled=_settled,
)
def segment(capture: Capture, camera: str, settings: Config, run: Recorder, device: str = "auto") -> Written:
    """One camera of a capture -> masks: masks.npz and masks.png."""
    from neuspring.checks.masks import mask_facts
    from neuspring.checks.perceived import look_at_masks
    from neuspring.core.findings import findings_as_facts
    from neuspring.data.frames import without_islands
    from neuspring.data.results import Masks
    from neuspring.perception import figures

    capture.require_camera(camera)
    backend = segmentation(settings.perception.segment.backend, capture)
    labels = without_islands(capture, camera, BACKENDS["segment"][backend].segment(capture, camera, settings.perception, device))
    facts = mask_facts(capture, camera, labels)
    findings = look_at_masks(capture, camera, labels, facts)
    masks = Masks(labels=labels, backend=backend, facts=facts)
    files = run.beside(masks="masks.npz", picture="masks.png")
    masks.save(files["masks"])
    figures.masks_strip(capture, camera, masks, files["picture"])
    return Written(files=files, facts=masks.facts | findings_as_facts(findings))
