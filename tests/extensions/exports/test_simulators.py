"""Newton and MuJoCo: their rollouts of the exported models against ours, with the same time step, and where they must differ."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from neuspring.core.errors import InputError
from neuspring.extensions.exports.formats import mujoco as mujoco_format
from neuspring.extensions.exports.formats import newton as newton_format
from neuspring.extensions.exports.source import read_source
from neuspring.twin.rollout import roll_out
from tests.extensions.exports import exported

NEWTON = 2e-6
"""m, over six frames of 60 steps, float32 on both sides. Measured: 2.6e-7."""
SWING = 5e-7
"""m, of MuJoCo without drag, over six frames of 60 steps. Measured: 3.3e-8."""
LARGEST, MEAN = 0.003, 0.0008
"""m, of nodes on MuJoCo's ground in frame 12. Measured: 3.6e-4 and 2.2e-4."""


def swinging(tmp_path, material=None, **options):
    """A rope that swings from the start."""
    twin = exported.stretched(exported.rope(**options), 1.1)
    twin = replace(twin, material=replace(twin.material, **(material or {})))
    return read_source(exported.run_folder(tmp_path, twin, with_splats=False))


@pytest.mark.parametrize("options", [{}, {"up": "-z"}, {"controller_velocity": True}], ids=["plain", "-z up", "hand velocity"])
def test_newton_swings_as_we_do(tmp_path, options):
    source, folder = swinging(tmp_path, ground=False, **options), tmp_path / "out"
    newton_format.write(source, range(exported.FRAMES), folder)
    spec = importlib.util.spec_from_file_location("newton_twin", folder / "newton_twin.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    assert np.abs(source.positions - script.simulate(folder, exported.FRAMES - 1)).max() < NEWTON
    assert np.abs(source.positions[-1] - source.positions[0]).max() > 0.05


def test_the_hands_are_needed_from_the_start(tmp_path):
    with pytest.raises(InputError, match="Give 0:STOP"):
        newton_format.write(swinging(tmp_path), [2, 3], tmp_path / "out")


def by_mujoco(source, folder):
    """Positions [F, N, 3] by the script of the page for MuJoCo."""
    pytest.importorskip("mujoco", reason="mujoco-core is not installed (extra `export`)")
    mujoco_format.write(source, range(len(source.positions)), folder)
    exported.run_page_script(1, folder)
    return np.load(folder / "mujoco.npy")


def test_without_drag_and_ground_mujoco_swings_as_we_do(tmp_path):
    source = swinging(tmp_path, {"drag": 0.0}, ground=False)
    assert np.abs(source.positions - by_mujoco(source, tmp_path / "out")).max() < SWING


def test_hands_that_only_push(tmp_path):
    """The rope of frame 0 is stretched, and its hand moves away: MuJoCo lets it go as we do. Newton has no such springs."""
    twin = exported.stretched(exported.rope(ground=False), 1.1)
    led = np.arange(len(twin.topology.springs)) >= twin.topology.object_spring_count
    dashpot = np.where(led, 0.0, twin.material.dashpot)
    twin = replace(twin, topology=replace(twin.topology, pushes=led), material=replace(twin.material, drag=0.0, dashpot=dashpot))
    source = read_source(exported.run_folder(tmp_path, twin, with_splats=False))
    assert np.abs(source.positions - swinging(tmp_path / "held", {"drag": 0.0}, ground=False).positions).max() > 0.01
    assert np.abs(source.positions - by_mujoco(source, tmp_path / "out")).max() < SWING
    with pytest.raises(InputError, match="whose hands only push"):
        newton_format.write(source, range(exported.FRAMES), tmp_path / "newton")


@pytest.mark.parametrize("up", [1, -1], ids=["+z up", "-z up"])
def test_a_rope_that_is_dragged_slides_on_the_ground_of_mujoco_as_on_ours(tmp_path, up):
    """Aslant, since a pyramid of friction brakes otherwise there: 4.3 mm. With MuJoCo's own friction it is 14 mm."""
    low, frames = np.array([0, 0, -0.047]), 13
    twin = exported.rope(up="+z" if up > 0 else "-z")
    places = {name: (getattr(twin.topology, name) + low) * [1, 1, up] for name in ("nodes", "controllers")}
    twin = replace(twin, topology=replace(twin.topology, **places), material=replace(twin.material, ground_friction=0.2))
    hands = twin.topology.controllers + np.arange(frames)[:, None, None] * np.array([0.01, 0.006, 0.0])
    twin.save(tmp_path / "twin.npz")
    moved = {"positions": roll_out(twin, hands).positions, "hands": hands, "frames": np.arange(frames)}
    source = replace(read_source(tmp_path / "twin.npz"), holds=np.ones((frames, 1), bool), **moved)
    assert (np.abs(source.positions[12, :, 2]) < 1e-3).sum() > exported.NODES / 2, "most nodes touch the ground"
    apart = np.linalg.norm(source.positions - by_mujoco(source, tmp_path / "out"), axis=2)[12]
    assert apart.max() < LARGEST and apart.mean() < MEAN


def test_frictions_of_mujocos_contacts_are_ours(tmp_path):
    """MuJoCo takes the greater of two, and 1.0 where none is given."""
    mujoco = pytest.importorskip("mujoco", reason="mujoco-core is not installed (extra `export`)")
    twin = exported.rope(self_collision=True)
    near = twin.topology.nodes * [0.2, 1, 0]
    replace(twin, topology=replace(twin.topology, nodes=near)).save(tmp_path / "twin.npz")
    model = mujoco.MjModel.from_xml_string(mujoco_format.mjcf(read_source(tmp_path / "twin.npz")))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ground = (data.contact.geom == model.geom("ground").id).any(axis=1)
    assert ground.any() and not ground.all()
    np.testing.assert_allclose(data.contact.friction[:, 0], np.where(ground, 0.4, 0.3))


def test_a_first_velocity_is_a_keyframe(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="mujoco-core is not installed (extra `export`)")
    source = swinging(tmp_path)
    moving = replace(source, velocity=np.full(source.velocity.shape, 0.25))
    model = mujoco.MjModel.from_xml_string(mujoco_format.mjcf(moving))
    assert np.allclose(model.key_qvel, 0.25) and not mujoco.MjModel.from_xml_string(mujoco_format.mjcf(source)).nkey
