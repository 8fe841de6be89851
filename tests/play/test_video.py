"""A recorded interaction as a video: what is drawn, where, and what is refused."""

import av
import numpy as np
import pytest

from neuspring.cli.main import main
from neuspring.core.errors import InputError
from neuspring.play.controls import Controls
from neuspring.play.results import find
from neuspring.play.video import HAND, _camera, write_video
from tests.support.played import dressed, results, rod_results

FRAMES, NODE = 5, 4


def pulled(run, height: float = 0.3) -> Controls:
    """A pull upwards."""
    nodes, hands = run.twin.topology.nodes, run.twin.topology.controllers
    target = nodes[NODE] + np.linspace(0, 1, FRAMES)[:, None] * np.array([0, 0, height])
    return Controls(
        hands=np.tile(hands, (FRAMES, 1, 1)),
        grabbed=np.full(FRAMES, NODE),
        target=target,
        scenario="small",
        method=run.method,
        seed=run.seed,
        twin_digest=run.twin_digest,
    )


def read(path) -> np.ndarray:
    """The pictures of a video [F, H, W, 3]."""
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_a_recording_is_written_as_a_video(scenario, tmp_path, capsys):
    found = find([scenario])
    pulled(found.runs[-1]).save(tmp_path / "controls.npz")
    wanted = tmp_path / "film.mp4"
    assert main(["play", str(scenario), "--replay", str(tmp_path / "controls.npz"), "--video", str(wanted)]) == 0
    assert f"{FRAMES + 1} frames, nodes and springs" in capsys.readouterr().out
    pictures = read(wanted)
    assert pictures.shape == (FRAMES + 1, 720, 960, 3)
    assert (pictures[0] < 200).any(axis=2).mean() > 0.002 and (pictures[0] != pictures[-1]).mean() > 0.001


def test_a_rod_is_drawn_as_its_center_line(tmp_path):
    found = find([rod_results(tmp_path)])
    (run,) = found.runs
    film = write_video(found, run, pulled(run), tmp_path / "film.mp4")
    assert film.kind == "nodes and springs"
    pictures = read(film.path)
    assert (pictures[0] < 200).any(axis=2).mean() > 0.002 and (pictures[0] != pictures[-1]).mean() > 0.001


def test_a_run_with_splats_is_drawn_as_splats(scenario, tmp_path):
    dressed(scenario)
    found = find([scenario])
    film = write_video(found, found.runs[-1], pulled(found.runs[-1]), tmp_path / "film.mp4")
    assert film.kind == "splats"
    plain = results(tmp_path / "plain")
    without = write_video(find([plain]), find([plain]).runs[-1], pulled(found.runs[-1]), tmp_path / "plain.mp4")
    covered, points = ((read(path)[0] < 230).any(axis=2).mean() for path in (film.path, without.path))
    assert covered > points > 0


def test_the_hands_are_where_the_camera_sees_them(scenario, tmp_path):
    found = find([scenario])
    run = found.runs[-1]
    write_video(found, run, pulled(run), tmp_path / "film.mp4")
    view = _camera(found, run.twin, None)
    ((x, y),) = np.round(view.project(run.twin.topology.controllers[:1].astype(float))[0]).astype(int)
    assert np.abs(read(tmp_path / "film.mp4")[0][y, x].astype(int) - HAND).max() < 60
    with pytest.raises(InputError, match="must be a camera of the capture"):
        write_video(found, run, pulled(run), tmp_path / "other.mp4", "7")
    assert not (tmp_path / "other.mp4").exists()


def test_what_needs_a_recording_and_a_frame_that_is_not_there_are_refused(scenario, capsys):
    for option in (["--compare"], ["--video", "film.mp4"], ["--camera", "0"]):
        assert main(["play", str(scenario), *option]) == 2
        assert "Give it with --replay FILE" in capsys.readouterr().err
    assert main(["play", str(scenario), "--frame", "99"]) == 2
    assert "has the frames 0 to 7" in capsys.readouterr().err
