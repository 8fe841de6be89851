"""The steps from a capture to observations: each reads artefacts, computes with the chosen backend, writes an artefact, a picture
and a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuspring import config
from neuspring.config import Config, ScenarioRow
from neuspring.core.artifacts import Observations, Scenario
from neuspring.core.errors import InputError
from neuspring.core.records import StageRecord, Stopwatch, digest_file
from neuspring.data.capture import CAPTURE, HANDS, OBJECT, Capture
from neuspring.data.check_capture import objects
from neuspring.perception.results import LiftedTracks, Masks, PixelTracks, ShapePrior, masks_of_cameras


def make_capture(row: ScenarioRow, settings: Config, output: Path) -> None:
    """A capture folder, whose capture.json is `output`, of a synthetic scene or of PhysTwin's raw layout.

    The truth of a synthetic scene lies beside the folder and is never read by a method.
    """
    if row.source == "synthetic":
        from neuspring.data.synthetic.make import make

        _, truth = make(row, settings.synthetic, output.parent)
        moved = f"{1e3 * truth.certificate:.2g} mm by twice as many, {1e3 * truth.sensitivity:.2g} mm by a start 1 um off"
        energy = truth.kinetic[-1] + truth.potential[-1]
        print(f"{row.scenario}: {truth.substeps} substeps per frame; mean node moved {moved}", flush=True)
        print(f"{row.scenario}: smallest det F {truth.least_jacobian.min():.2f}; energy at the end {energy:.3f} J", flush=True)
    elif row.source in ("phystwin_raw", "phystwin"):
        from neuspring.data import phystwin_raw

        phystwin_raw.convert(row, Path(settings.data_root or ".") / row.path, output.parent)
    else:
        raise InputError(
            f"scenario {row.scenario}, source", "captures are made of synthetic, phystwin_raw and phystwin scenarios", row.source
        )


def segment(folder: Path, camera: str, settings: Config, device: str, output: Path) -> None:
    """Capture -> masks.npz and masks.png of one camera, masks.json."""
    from neuspring.perception import figures

    clock = Stopwatch()
    capture, chosen = Capture.load(folder), settings.perception.segment
    _require_camera(capture, camera)
    if chosen.backend == "given":
        labels = _given(capture, camera)
    elif chosen.backend == "opencv":
        from neuspring.perception import segment_opencv

        labels = segment_opencv.segment(capture, camera, chosen.opencv)
    else:
        from neuspring.core.device import resolve_device
        from neuspring.perception import segment_sam2

        labels = segment_sam2.segment(capture, camera, chosen.grounded_sam2, resolve_device(device))
    facts = _mask_facts(capture, camera, labels)
    masks = Masks(labels=labels, backend=chosen.backend, facts=facts)
    path = output.with_name("masks.npz")
    masks.save(path)
    picture = figures.masks_strip(capture, camera, masks, output.with_name("masks.png"))
    _record(clock, "segment", {"masks": path, "picture": picture}, masks.facts, chosen, folder).save(output)


def track(folder: Path, camera: str, masks_record: Path, settings: Config, device: str, output: Path) -> None:
    """Capture and masks of one camera -> tracks.npz and tracks.png, tracks.json."""
    from neuspring.perception import figures

    clock = Stopwatch()
    capture, chosen = Capture.load(folder), settings.perception.track
    masks = Masks.load(StageRecord.load(masks_record).file("masks", masks_record))
    _require_camera(capture, camera)
    if chosen.backend == "opencv":
        from neuspring.perception import track_opencv

        found = track_opencv.track(capture, camera, masks.labels, chosen.opencv, settings.perception.seed)
    elif chosen.backend == "truth":
        from neuspring.perception import track_truth

        found = track_truth.track(capture, camera, masks.labels, chosen.opencv.points, settings.perception.seed)
    else:
        from neuspring.core.device import resolve_device
        from neuspring.perception import track_cotracker

        found = track_cotracker.track(
            capture, camera, masks.labels, chosen.cotracker3, settings.perception.seed, resolve_device(device)
        )
    count = found.pixels.shape[1]
    if not count:
        print(f"camera {camera}: neither object nor hands in frame 0; it is not used", flush=True)
    facts = {"points": float(count), "visible_share": float(found.visible.mean()) if count else 0.0}
    tracks = PixelTracks(pixels=found.pixels, visible=found.visible, backend=chosen.backend, facts=facts)
    path = output.with_name("tracks.npz")
    tracks.save(path)
    picture = figures.tracks_strip(capture, camera, tracks, output.with_name("tracks.png"))
    _record(clock, "track", {"tracks": path, "picture": picture}, tracks.facts, chosen, folder).save(output)


def lift(folder: Path, masks: Sequence[Path], tracks: Sequence[Path], settings: Config, output: Path) -> None:
    """Records of masks and tracks of all cameras, in the capture's order -> lifted.npz, shape.npz and lifted.png, lifted.json."""
    from neuspring.perception import figures
    from neuspring.perception.lift import lift as run
    from neuspring.perception.shape_prior import shape_prior

    clock = Stopwatch()
    capture, chosen = Capture.load(folder), settings.perception
    loaded, followed = _of_cameras(capture, masks, tracks)
    lifted = run(capture, loaded, followed, chosen.lift)
    prior = shape_prior(capture, loaded, lifted.cloud, chosen.shape)
    paths = {"lifted": output.with_name("lifted.npz"), "shape": output.with_name("shape.npz")}
    lifted.save(paths["lifted"])
    prior.save(paths["shape"])
    paths["picture"] = figures.lifted_figure(lifted, prior, output.with_name("lifted.png"))
    facts = {**lifted.facts, **{f"shape_{name}": value for name, value in prior.facts.items()}}
    _record(clock, "lift", paths, facts, (chosen.lift, chosen.shape), folder).save(output)


def judge(folder: Path, masks: Sequence[Path], tracks: Sequence[Path], lifted_record: Path, settings: Config, output: Path) -> None:
    """What perception made of a synthetic capture -> its errors against the truth, judged.json."""
    from neuspring.data.synthetic.truth import truth_of
    from neuspring.perception import judge as judges

    clock, capture = Stopwatch(), Capture.load(folder)
    loaded, followed = _of_cameras(capture, masks, tracks)
    lifted = LiftedTracks.load(StageRecord.load(lifted_record).file("lifted", lifted_record))
    known = truth_of(capture)
    facts = judges.judge(capture, known, loaded, followed, lifted, settings.perception.shape)
    backends = {"segment": next(iter(loaded.values())).backend, "track": next(iter(followed.values())).backend}
    clip = {"certificate_mm": 1e3 * known.certificate, "sensitivity_mm": 1e3 * known.sensitivity}
    clip |= {"least_jacobian": float(known.least_jacobian.min()), "frames": float(capture.frame_count)}
    _record(
        clock, "judge", {}, {**facts, **clip, **backends, **capture.description.provenance}, settings.perception.shape, folder
    ).save(output)


def assemble(row: ScenarioRow, folder: Path, lifted_record: Path, settings: Config) -> Observations:
    """Lifted tracks and shape prior -> observations: one structure point per voxel, tracks for scoring from the capture."""
    from neuspring.perception.sample import on_table, structure

    capture, chosen = Capture.load(folder), settings.perception
    record = StageRecord.load(lifted_record)
    lifted, prior = LiftedTracks.load(record.file("lifted", lifted_record)), ShapePrior.load(record.file("shape", lifted_record))
    up = 1.0 if capture.description.up == "+z" else -1.0
    kept, surface, interior = structure(lifted, prior, chosen.sample, up, chosen.seed)
    visible = lifted.object_visibility[:, kept]
    points = np.where(visible[..., None], on_table(lifted.object_points[:, kept], up), 0.0)
    return Observations(
        scenario=Scenario(
            name=row.scenario,
            source=row.source,
            category=row.category,
            frame_count=capture.frame_count,
            train_end=capture.train_end,
            frame_rate=capture.description.frame_rate,
            up=capture.description.up,
            self_collision=row.self_collision,
            ground=row.ground,
            provenance=capture.description.provenance
            | {CAPTURE: f"sha256:{digest_file(folder / CAPTURE)}", "lift": lifted.backend, "shape prior": prior.backend},
        ),
        object_points=points,
        object_visibility=visible,
        object_motion_valid=lifted.object_motion_valid[:, kept],
        controller_points=lifted.controller_points,
        surface_points=surface,
        interior_points=interior,
        tracks=capture.tracks(),
    )


def _of_cameras(capture: Capture, masks: Sequence[Path], tracks: Sequence[Path]) -> tuple[dict[str, Masks], dict[str, PixelTracks]]:
    """Masks and tracks by camera, from records in the capture's order."""
    loaded = masks_of_cameras(capture, masks)
    if len(tracks) != len(capture.cameras):
        raise InputError("--tracks", f"one record per camera is required: {list(capture.cameras)}", len(tracks))
    followed = {
        n: PixelTracks.load(StageRecord.load(path).file("tracks", path)) for n, path in zip(capture.cameras, tracks, strict=True)
    }
    return loaded, followed


def _mask_facts(capture: Capture, camera: str, labels: np.ndarray) -> dict[str, float]:
    """Quality numbers of masks; what makes a result worse is also said."""
    there = [frame for frame in range(capture.frame_count) if capture.has(camera, frame)]
    gone = [frame for frame in there if not (labels[frame] == OBJECT).any()]
    count = objects(labels[0])
    if count > 1:
        print(
            f"camera {camera}: the object's mask of frame 0 has {count} pieces far apart; two objects become one twin", flush=True
        )
    if gone:
        print(
            f"camera {camera}: no object in {len(gone)} frames, first in frame {gone[0]}; its points are invisible there",
            flush=True,
        )
    shares = {"object_share": float((labels == OBJECT).mean()), "hand_share": float((labels == HANDS).mean())}
    return shares | {
        "objects": float(count),
        "frames_without_object": float(len(gone)),
        "frames_missing": float(len(labels) - len(there)),
    }


def _given(capture: Capture, camera: str) -> np.ndarray:
    if not capture.description.masks:
        rule = "perception.segment.backend: given needs masks: true and the folder mask/"
        raise InputError(capture.folder / CAPTURE, rule, "masks: false", "Choose another backend: opencv or grounded_sam2.")
    of = capture.cameras[camera]
    labels = np.zeros((capture.frame_count, of.height, of.width), dtype=np.uint8)
    for frame in range(capture.frame_count):
        if capture.has(camera, frame):
            labels[frame] = capture.mask(camera, frame)
    return labels


def _require_camera(capture: Capture, camera: str) -> None:
    if camera not in capture.cameras:
        raise InputError(capture.folder / CAPTURE, f"must have a camera {camera}", sorted(capture.cameras))


def _record(clock: Stopwatch, stage: str, files: Mapping[str, Path], facts: Mapping[str, Any], chosen: Any, folder: Path) -> Any:
    sections = chosen if isinstance(chosen, tuple) else (chosen,)
    settings = {type(section).__name__: config.plain(section) for section in sections}
    inputs = {"capture": digest_file(folder / CAPTURE)}
    return clock.stage(stage, "ok", dict(files), facts=dict(facts), settings=settings, inputs=inputs)
