"""Artifacts: files are read as they were written, errors name the fault, an interrupted write keeps the old file."""

import dataclasses
import json
import os

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neuspring.core import artifacts
from neuspring.core.artifacts import Artifact, Material, Simulation, Topology, Trajectory, Twin
from neuspring.core.errors import InputError
from tests.support.scenarios import observations, scenario


def topology(**changes):
    values = {
        "nodes": np.random.default_rng(0).random((4, 3)),
        "controllers": np.ones((1, 3)),
        "springs": np.array([[0, 1], [1, 2], [4, 3]]),
        "rest_lengths": np.array([0.1, 0.2, 0.3]),
        "labels": np.array([0, 0, 1, 1]),
    }
    return Topology(**(values | changes))


def material(**changes):
    values = {"stiffness": np.array([1.0, 2.0, np.pi]), "dashpot": np.zeros(3), "drag": 0.1}
    values |= dict.fromkeys(artifacts.SCALARS[1:], 0.3)
    return Material(**(values | changes))


def twin():
    return Twin(topology=topology(), material=material(), simulation=Simulation(frame_time=1 / 30, substeps=7, up="-z"))


def trajectory(**changes):
    return Trajectory(**({"positions": np.random.default_rng(1).random((3, 4, 3)), "frame_count": 3} | changes))


MAKERS = {
    "scenario": lambda: scenario(provenance={"file": "a.pkl", "digest": "0f"}, ground=False, up="-z"),
    "observations": lambda: observations(tracks=np.where(np.arange(10).reshape(5, 2, 1) % 3, 1 / 3, np.nan).repeat(3, axis=2)),
    "topology": lambda: topology(controller_rest="first_frame"),
    "material": lambda: material(mass=np.array([0.5, 1.0, 1.5, 1.0])),
    "twin": twin,
    "trajectory": trajectory,
    "diverged trajectory": lambda: trajectory(frame_count=9, diverged_frame=3, reason="node 0 left", collision_overflow=2),
}


def assert_same(a, b):
    """Equal, bit for bit, field by field."""
    assert type(a) is type(b)
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, Artifact):
            assert_same(x, y)
        elif isinstance(x, np.ndarray):
            assert x.dtype == y.dtype == field.metadata["dtype"]
            assert x.shape == y.shape
            assert x.tobytes() == y.tobytes()
        else:
            assert x == y
            assert type(x) is type(y)


# Round trips ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MAKERS)
def test_round_trip(name, tmp_path):
    made, path = MAKERS[name](), tmp_path / "new folder" / "it.npz"
    made.save(path)
    assert_same(type(made).load(path), made)
    assert os.listdir(path.parent) == ["it.npz"]
    assert path.stat().st_mode & 0o777 == 0o644
    with np.load(path, allow_pickle=False) as stored:
        assert not any(stored[key].dtype.hasobject for key in stored.files)
        meta = json.loads(stored["meta"].tobytes())
    assert (meta["kind"], meta["format"]) == (made.kind, artifacts.FORMAT_VERSION)


def test_arrays_are_copied_cast_and_frozen():
    nodes = np.random.default_rng(0).random((4, 3))
    made = topology(nodes=nodes)
    nodes[:] = 0
    assert made.nodes.any()
    assert made.nodes.dtype == np.float32
    with pytest.raises(ValueError, match="read-only"):
        made.nodes[0] = 0
    with pytest.raises(dataclasses.FrozenInstanceError):
        made.nodes = nodes


# Validation: the message names the field, the rule and the value ------------------------------------------------------

BROKEN = {
    "dimensions": (lambda: topology(nodes=np.zeros(4)), r"topology\.nodes: the shape must be \[N, 3\] float32; received \(4,\)"),
    "axis": (lambda: topology(nodes=np.zeros((4, 2))), r"topology\.nodes: .*axis 1 must have 3 entries; received \(4, 2\)"),
    "agreement": (lambda: topology(rest_lengths=np.ones(2)), r"topology\.rest_lengths: .*axis 0 must have 3 entries"),
    "dtype": (lambda: topology(springs=np.zeros((3, 2))), r"topology\.springs: the dtype must be int32; received float64"),
    "not bool": (lambda: observations(object_visibility=np.ones((5, 3), int)), r"object_visibility: .*bool; received int64"),
    "nan": (lambda: topology(nodes=np.full((4, 3), np.nan)), r"nodes: every entry must be finite; received nan at index \(0"),
    "integers that do not fit": (lambda: topology(labels=np.full(4, 2**40)), r"topology\.labels"),
    "scenario name": (lambda: scenario(name="../etc"), r"scenario\.name.*'\.\./etc'"),
    "split": (lambda: scenario(train_end=9), r"scenario scene, split: 1 < train_end <= frame_count = 5.*train_end = 9"),
    "frame rate": (lambda: scenario(frame_rate=0.0), r"frame_rate: a positive number.*received 0"),
    "up": (lambda: scenario(up="y"), r"up: must be '\+z' or '-z'; received 'y'"),
    "frames": (lambda: observations(scenario=scenario(frame_count=6)), r"declares 6 frames; received arrays of 5 frames"),
    "no points": (lambda: observations(points=0), r"at least one tracked object point"),
    "hidden at rest": (lambda: observations(object_visibility=np.zeros((5, 3), bool)), r"visible in frame 0.*3 of 3 are not"),
    "index": (lambda: topology(springs=np.array([[0, 1], [1, 2], [5, 3]])), r"topology\.springs: indices must be in \[0, 5\)"),
    "order": (lambda: topology(springs=np.array([[0, 1], [4, 2], [1, 3]])), r"object springs must come before controller springs"),
    "zero length": (lambda: topology(rest_lengths=np.array([0.1, 0.0, 0.3])), r"received 0\.0 m for spring 1 between \[1, 2\]"),
    "negative stiffness": (lambda: material(stiffness=np.array([1.0, -2, 1])), r"stiffness: must not be negative; received -2"),
    "nan friction": (lambda: material(ground_friction=float("nan")), r"material\.ground_friction: must be finite"),
    "substeps": (lambda: Simulation(frame_time=0.1, substeps=0), r"simulation: .*substeps >= 1"),
    "one value per spring": (
        lambda: dataclasses.replace(twin(), material=material(stiffness=np.ones(2), dashpot=np.ones(2))),
        r"one stiffness per spring \(3\); received 2",
    ),
    "masses": (lambda: dataclasses.replace(twin(), material=material(mass=np.ones(3))), r"one mass per node \(4\), or none"),
    "no mass": (lambda: material(mass=np.array([1.0, 0.0])), r"material\.mass: must be positive"),
    "rest shape": (lambda: topology(rest_shape=np.ones((4, 3))), r"rest_shape: must contain one position per node and .*\(5\)"),
    "frames of a trajectory": (lambda: trajectory(frame_count=4), r"trajectory\.positions: 4 frames are expected; received 3"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_rules_are_named(name):
    make, message = BROKEN[name]
    with pytest.raises(InputError, match=message):
        make()


def test_drifted_contact_scalars_are_accepted():
    """Released checkpoints hold values just outside the clamps (quirk 5): clamped on use, not refused."""
    assert material(ground_elasticity=-0.0103, contact_friction=2.0112).contact_friction == 2.0112


# Reading other files --------------------------------------------------------------------------------------------------


def rewrite(path, **changes):
    """Change the meta text of a stored artifact."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = {key: stored[key] for key in stored.files}
    meta = json.loads(arrays["meta"].tobytes()) | changes
    arrays["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    np.savez(path, **arrays)


def refuses(kind, path, message):
    with pytest.raises(InputError, match=message) as caught:
        kind.load(path)
    assert str(path) in str(caught.value)


def test_a_missing_file(tmp_path):
    refuses(Twin, tmp_path / "no.npz", "must be of kind twin; received no such file. Run the step that writes it first")
    refuses(Twin, tmp_path, "no such file")


def test_another_kind_or_version(tmp_path):
    path = tmp_path / "it.npz"
    twin().save(path)
    refuses(Trajectory, path, r"must be of kind trajectory, format 2; received \('twin', 2\)")
    rewrite(path, format=99)
    refuses(Twin, path, r"received \('twin', 99\)\. Rerun")


def test_what_is_optional_may_be_missing_in_a_file(tmp_path):
    path = tmp_path / "old.npz"
    topology().save(path)
    with np.load(path) as stored:
        np.savez(path, **{name: stored[name] for name in stored.files if name != "rest_shape"})
    assert_same(Topology.load(path), topology())


@pytest.mark.parametrize(("part", "name"), [("material", "drag_quadratic"), ("simulation", "controller_path")])
def test_fields_of_another_version_are_refused(tmp_path, part, name):
    path = tmp_path / "old.npz"
    twin().save(path)
    with np.load(path) as stored:
        kept = json.loads(stored["meta"].tobytes())["fields"]
    kept[part][name] = 0.0
    rewrite(path, fields=kept)
    refuses(Twin, path, f"and no others.*{name}.*rerun the step that writes it")


def test_missing_fields(tmp_path):
    path = tmp_path / "it.npz"
    trajectory().save(path)
    rewrite(path, fields={})
    refuses(Trajectory, path, "every field of kind trajectory.*KeyError: 'frame_count'")
    trajectory().save(path)
    with np.load(path) as stored:
        meta = stored["meta"]
    np.savez(path, meta=meta)
    refuses(Trajectory, path, "every field of kind trajectory.*positions")


def damaged(path, content):
    path.write_bytes(content)
    refuses(Twin, path, r"must be readable and of kind twin.*Delete it and rerun its step")


def test_truncated_files(tmp_path):
    path = tmp_path / "it.npz"
    twin().save(path)
    whole = path.read_bytes()
    for length in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        damaged(path, whole[:length])


def test_foreign_files(tmp_path):
    """Text, an npy, an npz without meta, an npz whose meta is no mapping, and a pickle."""
    path = tmp_path / "it.npz"
    damaged(path, b"hello")
    for write in (
        lambda f: np.save(f, np.zeros(3)),
        lambda f: np.savez(f, a=np.zeros(3)),
        lambda f: np.savez(f, meta=np.frombuffer(b"[1]", np.uint8)),
        lambda f: np.savez(f, meta=np.frombuffer(b"\xff", np.uint8)),
        lambda f: np.savez(f, meta=np.array([{}], dtype=object)),
    ):
        with path.open("wb") as stream:
            write(stream)
        damaged(path, path.read_bytes())


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_flipped_byte_is_refused_or_harmless(data, tmp_path):
    path = tmp_path / "it.npz"
    trajectory().save(path)
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    try:
        found = Trajectory.load(path)
    except InputError:
        return
    assert_same(found, trajectory())


# Writing --------------------------------------------------------------------------------------------------------------


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "it.npz"
    trajectory().save(path)
    before = path.read_bytes()

    def fail(stream, **_):
        stream.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(KeyboardInterrupt):
        trajectory(frame_count=9, diverged_frame=3).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["it.npz"]
