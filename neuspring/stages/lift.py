"""Masks and tracks of all cameras -> points in the world, and a shape prior."""

from __future__ import annotations

from collections.abc import Sequence

from neuspring.config import Config
from neuspring.core.records import Before, Recorder
from neuspring.data.capture import Capture
from neuspring.stages.stage import Written, paths, stage


@stage(
    output="{scenario}/perception/lifted.json",
    reads=("perception.lift", "perception.shape", "perception.color"),
    memory_mb=8000,
    minutes=60,
    when=lambda rows: rows.source.films,
    also=lambda rows: [mesh] if (mesh := rows.config.perception.shape.mesh) else [],
)
def lift(capture: Capture, masks: Sequence[Before], tracks: Sequence[Before], settings: Config, run: Recorder) -> Written:
    """Masks and tracks of all cameras -> points in the world, shape prior: lifted.npz, shape.npz and lifted.png.

    Of color alone also image.npz: what losses read of the image.
    """
    from neuspring.checks.perceived import look_at_lifted
    from neuspring.core.findings import findings_as_facts
    from neuspring.data.results import masks_of_cameras, tracks_of_cameras
    from neuspring.intake.points import read
    from neuspring.perception import figures
    from neuspring.perception.given import from_image
    from neuspring.perception.lift import lift as lift_points
    from neuspring.perception.shape import no_prior, shape_prior

    perception = settings.perception
    masks_of, tracks_of = masks_of_cameras(capture, paths(masks)), tracks_of_cameras(capture, paths(tracks))
    image = None
    if capture.has_depth:
        lifted = lift_points(capture, masks_of, tracks_of, perception.lift)
        given = len(read(capture).nodes)
        prior = no_prior() if given else shape_prior(capture, masks_of, lifted.cloud, perception.shape)
    else:
        lifted, prior, image = from_image(capture, masks_of, tracks_of, perception)
    # Whether its picture changes where no point is followed, `observe` cannot see.
    lifted.facts["object_moves"] = max(masks.facts.get("object_moves", 0.0) for masks in masks_of.values())
    files = run.beside(lifted="lifted.npz", shape="shape.npz", picture="lifted.png")
    if image is not None:
        files |= run.beside(image="image.npz", hands="hands.png")
        image.save(files["image"])
        figures.hands_strip(capture, image, lifted.controller_points, files["hands"])
    lifted.save(files["lifted"])
    prior.save(files["shape"])
    figures.lifted_figure(lifted, prior, files["picture"])
    facts = lifted.facts | {"shape": prior.backend} | {f"shape_{name}": value for name, value in prior.facts.items()}
    return Written(files=files, facts=facts | findings_as_facts(look_at_lifted(lifted, prior, capture.description.up_sign, image)))
