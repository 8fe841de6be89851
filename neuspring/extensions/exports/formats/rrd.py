"""Rerun: video, observations, prediction and the errors of each frame, on one timeline.

The export only writes a file, which `rerun FILE` opens. Colors and radii are stored once, positions per frame. Splats are omitted
because Rerun's format for them is not stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuspring.core.errors import InputError
from neuspring.core.extras import needed
from neuspring.core.files import write_atomically
from neuspring.data.capture import Capture
from neuspring.extensions.exports import Export
from neuspring.extensions.exports.formats.usd import colors
from neuspring.extensions.exports.source import ExportSource
from neuspring.report.shown import capture_of
from neuspring.scores.metrics import METRICS, errors_per_frame
from neuspring.twin.body import lines_of

LOOKS = {
    "predicted/nodes": ((204, 204, 204), 2.0),
    "hands": ((255, 153, 25), 4.0),
    "recorded/points": ((0, 150, 90), 1.5),
    "recorded/tracks": ((150, 0, 200), 4.0),
}
"""Color, and radius in screen points."""
SPRING_RADIUS = 0.5
RRD_JPEG_QUALITY = 90


def write(source: ExportSource, frames: Sequence[int], output: Path) -> list[Path]:
    """Write one file of these frames."""
    needed("rerun")
    if output.suffix != ".rrd":
        raise InputError("--output", "must end with .rrd", output.name)
    notes: list[str] = []
    folder, seen = source.scenario_folder, source.seen
    capture = capture_of(folder, seen, notes) if folder is not None and seen is not None else None
    for note in notes:
        print(f"The video is omitted: {note}")
    write_atomically(output, lambda path: _Recording(source.only(frames), path).write(source, capture))
    return [output]


class _Recording:
    """Writes one file with F exported frames."""

    def __init__(self, part: ExportSource, path: Path) -> None:
        self._part, self._rr = part, needed("rerun")
        self._stream = self._rr.RecordingStream("neuspring")
        self._stream.save(path)

    def write(self, source: ExportSource, capture: Capture | None) -> None:
        """Write all entities; `source` has all frames, because errors depend on all of them."""
        # Without this context Rerun logs errors and omits the data.
        with self._rr.error_utils.catch_and_log_exceptions("export", strict=True):
            self._stream.send_recording_name(source.name)
            self._still("about", self._rr.TextDocument(f"{source.name}: {source.weight}"))
            up = self._rr.ViewCoordinates
            self._still("world", up.RIGHT_HAND_Z_UP if source.twin.simulation.up == "+z" else up.RIGHT_HAND_Z_DOWN)
            self._motion()
            self._errors(source)
            if capture is not None:
                self._film(capture)
        self._stream.disconnect()

    def _motion(self) -> None:
        rr, part, lines = self._rr, self._part, lines_of(self._part.twin)
        clouds = {"predicted/nodes": list(part.positions), "hands": list(part.hands)}
        if (seen := part.seen) is not None:
            points, visible = seen.object_points[part.frames], seen.object_visibility[part.frames]
            clouds["recorded/points"] = [row[shown] for row, shown in zip(points, visible, strict=True)]
            clouds["recorded/tracks"] = [row[np.isfinite(row).all(axis=1)] for row in seen.tracks[part.frames]]
        for name, cloud_per_frame in clouds.items():
            color, radius = LOOKS[name]
            self._still(f"world/{name}", rr.Points3D.from_fields(colors=[color], radii=rr.Radius.ui_points(radius)))
            columns = rr.Points3D.columns(positions=np.concatenate(cloud_per_frame).astype(np.float32))
            self._over_time(f"world/{name}", columns.partition([len(cloud) for cloud in cloud_per_frame]))
        ends = [lines.points(nodes, hands)[lines.pairs] for nodes, hands in zip(part.positions, part.hands, strict=True)]
        look = {"colors": colors(lines.stiffness), "radii": rr.Radius.ui_points(SPRING_RADIUS)}
        self._still("world/predicted/springs", rr.LineStrips3D.from_fields(**look))
        strips = rr.LineStrips3D.columns(strips=np.concatenate(ends).astype(np.float32))
        self._over_time("world/predicted/springs", strips.partition([len(lines.pairs)] * len(ends)))

    def _errors(self, source: ExportSource) -> None:
        """One curve per metric of positions or annotated points, without frames that have no value."""
        if (seen := source.seen) is None:
            return
        errors = errors_per_frame(source.positions, seen) | errors_per_frame(source.positions, seen, "marks")
        for name, values in errors.items():
            metric, shown = METRICS[name], METRICS[name].factor * values[self._part.frames]
            known = np.isfinite(shown)
            self._still(f"errors/{name}", self._rr.SeriesLines(names=f"{metric.title} [{metric.shown_unit}]"))
            self._over_time(f"errors/{name}", self._rr.Scalars.columns(scalars=shown[known]), known)

    def _film(self, capture: Capture) -> None:
        rr, unit = self._rr, capture.description.depth_unit
        for name, camera in capture.cameras.items():
            path, pose = f"world/cameras/{name}", camera.camera_to_world
            size = [camera.width, camera.height]
            self._still(path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            self._still(path, rr.Pinhole(image_from_camera=camera.intrinsics, resolution=size, camera_xyz=rr.ViewCoordinates.RDF))
            for frame, time in zip(self._part.frames.tolist(), self._part.times.tolist(), strict=True):
                self._stream.set_time("frame", sequence=frame)
                self._stream.set_time("time", duration=time)
                if not capture.has(name, frame):
                    self._stream.log(path, rr.Clear(recursive=True))
                    continue
                self._stream.log(f"{path}/color", rr.Image(capture.color(name, frame)).compress(RRD_JPEG_QUALITY))
                if "depth" in capture.streams:
                    counts = np.rint(capture.depth(name, frame) / unit).astype(np.uint16)
                    self._stream.log(f"{path}/depth", rr.DepthImage(counts, meter=1 / unit))

    def _over_time(self, entity: str, columns: Any, known: Any = slice(None)) -> None:
        part, rr = self._part, self._rr
        indexes = [rr.TimeColumn("time", duration=part.times[known]), rr.TimeColumn("frame", sequence=part.frames[known])]
        self._stream.send_columns(entity, indexes, columns)

    def _still(self, entity: str, what: Any) -> None:
        self._stream.log(entity, what, static=True)


export = Export(write=write, name="{name}.rrd", then="Next: .venv/bin/rerun {output}")
