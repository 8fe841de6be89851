"""Rerun's files, read back without a viewer: places, times, errors, cameras and pictures are those of the run and its capture."""

from collections import defaultdict
from dataclasses import replace

import cv2
import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.data.images import write_image
from neuspring.extensions.exports.formats import rrd
from neuspring.extensions.exports.source import read_source
from neuspring.scores.metrics import errors_per_frame
from tests.extensions.exports import exported
from tests.extensions.rods.ropes import rod_results
from tests.support import captures

pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra `rerun`)")
RED = (200, 50, 20)
JPEG_LOSS = 6
LOST = 4
"""A frame that the camera missed."""


def read(path):
    """Rows by entity: {frame: {column: values}}, the frame None for what is static."""
    from rerun.chunk import RrdReader

    rows = defaultdict(dict)
    for chunk in RrdReader(path).stream():
        table = chunk.to_record_batch().to_pydict()
        frames = [None] * chunk.num_rows if chunk.is_static else table["frame"]
        for index, frame in enumerate(frames):
            values = {name: column[index] for name, column in table.items() if column[index] is not None}
            rows[chunk.entity_path].setdefault(frame, {}).update(values)
    return rows


def marked(seen):
    """The observations with hidden points, all of them in frame 5, and two tracks that are annotated in some frames."""
    tracks = np.array(seen.object_points[:, [1, 4]])
    tracks[3] = np.nan
    tracks[2, 1] = np.nan
    visible = np.array(seen.object_visibility)
    visible[2, :2] = visible[5] = False
    return replace(seen, tracks=tracks, object_visibility=visible)


@pytest.fixture
def folder(tmp_path):
    return exported.run_folder(tmp_path / "results", with_splats=False, change=marked)


@pytest.fixture
def filmed(folder):
    """The run with the capture of its scenario."""
    described = captures.describe(
        frame_count=exported.FRAMES, cameras=(captures.entry("left"), captures.entry("right", missing=(LOST,))), depth_unit=0.0005
    )
    capture = captures.write(folder.parents[1] / "capture", described)
    write_image(capture.path("color", "left", 3), np.full((24, 32, 3), RED[::-1], np.uint8))
    return folder, capture


def test_what_is_recorded_and_predicted_lies_on_one_timeline(folder, tmp_path):
    assert main(["export", str(folder), "--to", "rrd", "--frames", "0:7:2", "--output", str(tmp_path / "run.rrd")]) == 0
    rows, source, frames = read(tmp_path / "run.rrd"), read_source(folder), [0, 2, 4, 6]
    seen, springs = source.seen, source.twin.topology.springs
    for frame in frames:
        both = np.concatenate([source.positions[frame], source.hands[frame]])
        expected = {
            "predicted/nodes": source.positions[frame],
            "hands": source.hands[frame],
            "recorded/points": seen.object_points[frame][seen.object_visibility[frame]],
            "recorded/tracks": seen.tracks[frame][np.isfinite(seen.tracks[frame]).all(axis=1)],
        }
        for name, points in expected.items():
            row = rows[f"/world/{name}"][frame]
            assert np.array_equal(row["Points3D:positions"], points)
            assert row["time"].total_seconds() == pytest.approx(frame / 30, abs=1e-6)
        assert np.array_equal(rows["/world/predicted/springs"][frame]["LineStrips3D:strips"], both[springs])
    assert len(rows["/world/recorded/points"][2]["Points3D:positions"]) == exported.NODES - 2
    moving = {entity: {frame for frame in found if frame is not None} for entity, found in rows.items()}
    assert all(found <= set(frames) for found in moving.values())
    for name in ("predicted/nodes", "recorded/points", "recorded/tracks", "hands"):
        assert len(rows[f"/world/{name}"][None]["Points3D:colors"]) == 1, "colors are stored once"
        assert not any("Points3D:colors" in rows[f"/world/{name}"][frame] for frame in frames)
    assert len(rows["/world/predicted/springs"][None]["LineStrips3D:colors"]) == len(springs)
    assert "6.334 kg in all" in rows["/about"][None]["TextDocument:text"][0]


def test_a_point_that_is_not_seen_vanishes_and_errors_are_those_of_the_scores(folder, tmp_path):
    source = read_source(folder)
    rrd.write(source, range(exported.FRAMES), tmp_path / "run.rrd")
    rows, errors = read(tmp_path / "run.rrd"), errors_per_frame(source.positions, source.seen)
    assert rows["/world/recorded/points"][5]["Points3D:positions"] == []
    assert {"chamfer", "track_error"} <= errors.keys() and np.isnan(errors["chamfer"][5])
    for name, values in errors.items():
        shown = {frame: row["Scalars:scalars"][0] for frame, row in rows[f"/errors/{name}"].items() if frame is not None}
        known = {frame: 1e3 * value for frame, value in enumerate(values) if np.isfinite(value)}
        assert shown == pytest.approx(known) and max(shown.values()) > 1
        assert rows[f"/errors/{name}"][None]["SeriesLines:names"][0].endswith("[mm]")


def test_the_film_stands_where_its_cameras_stood(filmed, tmp_path):
    folder, capture = filmed
    rrd.write(read_source(folder), range(2, 6), tmp_path / "run.rrd")
    rows = read(tmp_path / "run.rrd")
    for name, camera in capture.cameras.items():
        place, still = f"/world/cameras/{name}", rows[f"/world/cameras/{name}"][None]
        np.testing.assert_allclose(still["Transform3D:translation"][0], camera.camera_to_world[:3, 3], rtol=1e-6)
        # Rerun stores matrices by columns.
        turned = np.reshape(still["Transform3D:mat3x3"][0], (3, 3)).T
        np.testing.assert_allclose(turned, camera.camera_to_world[:3, :3], atol=1e-6)
        np.testing.assert_allclose(np.reshape(still["Pinhole:image_from_camera"][0], (3, 3)).T, camera.intrinsics, rtol=1e-6)
        shown = {frame for frame in rows[f"{place}/color"] if "EncodedImage:blob" in rows[f"{place}/color"][frame]}
        assert shown == {2, 3, 4, 5} - ({LOST} if name == "right" else set())
        for frame in shown:
            row = rows[f"{place}/depth"][frame]
            assert row["DepthImage:meter"] == [2000.0]
            counts = np.array(row["DepthImage:buffer"][0], np.uint8).view(np.uint16).reshape(24, 32)
            np.testing.assert_allclose(counts / 2000, capture.depth(name, frame))
    assert rows["/world/cameras/right"][LOST]["Clear:is_recursive"] == [True], "the picture before does not stay"
    blob = np.array(rows["/world/cameras/left/color"][3]["EncodedImage:blob"][0], np.uint8)
    assert np.abs(cv2.imdecode(blob, cv2.IMREAD_COLOR)[..., ::-1].astype(int) - RED).max() <= JPEG_LOSS


def test_an_image_that_is_missing_leaves_no_half_file(filmed, tmp_path):
    folder, capture = filmed
    capture.path("color", "right", 2).unlink()
    with pytest.raises(InputError, match=r"right/00002\.png: this image must exist"):
        rrd.write(read_source(folder), [0, 2], tmp_path / "out" / "run.rrd")
    assert not list((tmp_path / "out").iterdir())


def test_a_twin_alone_upside_down_and_a_rod(folder, tmp_path):
    exported.rope(up="-z").save(tmp_path / "twin.npz")
    rrd.write(read_source(tmp_path / "twin.npz"), [0], tmp_path / "twin.rrd")
    rrd.write(read_source(folder), [0], tmp_path / "up.rrd")
    alone, upright = read(tmp_path / "twin.rrd"), read(tmp_path / "up.rrd")
    # Right, up, forward, down, left, back are 3, 1, 5, 2, 4, 6: the third axis is up, or down.
    up, down = [rows["/world"][None]["ViewCoordinates:xyz"][0][2] for rows in (upright, alone)]
    assert (up, down) == (1, 2) and "/errors/chamfer" in upright and "/errors/chamfer" not in alone
    source = read_source(rod_results(tmp_path, clamped=True) / "rod" / "0")
    rrd.write(source, [0, 5], tmp_path / "rod.rrd")
    strips = np.array(read(tmp_path / "rod.rrd")["/world/predicted/springs"][5]["LineStrips3D:strips"])
    assert len(strips) == len(source.twin.body.lengths) + len(source.twin.topology.springs)
    np.testing.assert_allclose(strips[2:5, 0], source.positions[5], atol=1e-6)


def test_another_suffix_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match=r"--output: must end with \.rrd; received run\.mcap"):
        rrd.write(read_source(folder), [0], tmp_path / "run.mcap")
