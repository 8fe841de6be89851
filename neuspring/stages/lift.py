"""Stage `lift`: masks and tracks of all cameras -> 3D points and a shape prior."""

from __future__ import annotations

from collections.abc import Sequence

from neuspring.config import Config
from neuspring.core.records import Before, Recorder
from neuspring.data.capture import Capture
from neuspring.perception.backends import LIFTERS
from neuspring.stages.stage import Written, paths, stage


@stage(
    output="{scenario}/perception/lifted.json",
    rule="perceive",
    reads=("perception.lift", "perception.shape"),
    code=lambda settings, given: [lifter.module for lifter in LIFTERS.values()],
    memory_mb=8000,
    minutes=60,
    when=lambda rows: rows.source.films,
    also=lambda rows: [mesh] if (mesh := rows.config.perception.shape.mesh) else [],
)
def lift(capture: Capture, masks: Sequence[Before], tracks: Sequence[Before], settings: Config, run: Recorder) -> Written:
    """Masks and tracks of all cameras -> 3D points, shape prior: lifted.npz, shape.npz and lifted.png.

    The capture's `depth` selects the lifter. Some lifters also write image.npz (image observations for losses), depth.npz (an
    estimated depth of frame 0) and figures.
    """
    from neuspring.core.files import write_npz
    from neuspring.core.findings import findings_as_facts
    from neuspring.data.frames import write_png
    from neuspring.data.results import masks_of_cameras, tracks_of_cameras
    from neuspring.perception import figures

    masks_of, tracks_of = masks_of_cameras(capture, paths(masks)), tracks_of_cameras(capture, paths(tracks))
    result = LIFTERS[capture.description.depth].lift(capture, masks_of, tracks_of, settings.perception)
    lifted, prior = result.tracks, result.prior
    # `observe` reads no images, so it cannot see motion where no point is tracked.
    lifted.facts["object_moves"] = max(masks.facts.get("object_moves", 0.0) for masks in masks_of.values())
    files = run.beside(lifted="lifted.npz", shape="shape.npz", picture="lifted.png")
    lifted.save(files["lifted"])
    prior.save(files["shape"])
    figures.lifted_figure(lifted, prior, files["picture"])
    if result.image is not None:
        files |= run.beside(image="image.npz")
        result.image.save(files["image"])
    if result.depths:
        files |= run.beside(depth="depth.npz")
        write_npz(files["depth"], result.depths, "{}", compress=True)
    for name, image in result.pictures.items():
        files |= run.beside(**{name: f"{name}.png"})
        write_png(files[name], image)
    facts = lifted.facts | {"shape": prior.backend} | {f"shape_{name}": value for name, value in prior.facts.items()}
    return Written(files=files, facts=facts | findings_as_facts(result.findings))
