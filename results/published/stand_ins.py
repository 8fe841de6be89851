"""Small substitutes for the data and results that the commands of this folder read, to try a command without them.

    python -m results.published.stand_ins beam.make FOLDER       # writes FOLDER and prints commands that read it

Their numbers are meaningless. `play.make` has no substitute, because it needs a browser.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd
from scipy.io import savemat
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, Delaunay

from neuspring.config import Config
from neuspring.config.parse import parse, read_yaml
from neuspring.core.records import Recorder, digest_file
from neuspring.core.run_folder import RunFolder
from neuspring.data.sample import sample_twin
from neuspring.extensions.rods.made import rod_twin
from neuspring.extensions.synthetic.truth import Truth, truth_path
from results.published.beam import make as beam
from results.published.film22 import films
from results.published.foam import make as foam
from results.published.pictures import pulled
from results.published.two_materials import beams
from tests.support import captures
from tests.support.c3d_files import write_c3d

ROOT = Path(__file__).parents[2]
SHARES, RELAXED = np.array([0.2, 0.1, 0.05, 0.04]), 6.8
"""Law of the beam: shares of its branches, and its relaxed frequency, Hz."""
CASE = "single_clift_cloth_1"
"""A case with annotations."""


class StandIn(NamedTuple):
    """Commands in order, without their script, and values of module names that make them take seconds."""

    commands: list[list[object]]
    smaller: dict[str, Any] = {}


def released(folder: Path, name: str, held: float, noise: float = 1e-5, seed: int = 0) -> Path:
    """A recording of 500 frames of a tip that is held `held` m above rest and released after 0.7 s (x up, z along)."""
    times = np.arange(500) / 100 - 0.704
    height = held * beam.motion((2 * np.pi * RELAXED) ** 2, SHARES, times)
    section = np.array([[0.07, 0.03, 0.1], [0.06, 0.05, 0.1], [0.04, 0.01, 0.09]])
    tip = section + height[:, None, None] * [1, 0, 0]
    tip += noise * np.random.default_rng(seed).standard_normal(tip.shape)
    base = np.broadcast_to([0.05, 0.01, 0.0], (500, 1, 3))
    points = np.concatenate([base, tip], axis=1)
    return write_c3d(folder / name, points, ["Base - 1", "Tip - 1", "Tip - 2", "Tip - 3"], "m", 100.0)  # type: ignore[no-any-return]


def of_beam(folder: Path) -> StandIn:
    """Two unloaded recordings and one under 52 g."""
    for name, held in {"gravity_V2_a": 6e-3, "gravity_V2_b": 7e-3, "load52_V2_a": 9e-3}.items():
        released(folder, f"{name}.c3d", held)
    kinds = {"lattice": beam.LatticeBeam(2), "rod": beam.RodBeam()}
    return StandIn([[folder, folder / "out"]], {"beam.make.KINDS": kinds, "beam.make.VERTICES": 7})


def of_silicones(folder: Path) -> StandIn:
    """Images of a beam at rest, of all three materials and twisted, from in front of the marker; the surface is a coarse box."""
    (folder / "cad").mkdir()
    corners = np.array([[x, y, z] for x in (-9.9, 9.9) for y in (-1.4, 1.4) for z in (-1.4, 1.4)])
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [
        f"f {a + 1}/1 {b + 1}/1 {c + 1}/1" for a, b, c in ConvexHull(corners).simplices
    ]
    (folder / "cad" / "cantilever_f1494_v749.obj").write_text("\n".join(lines))
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 0.05, 0.0, 0.6
    flat = beams.SIDE / 2 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    picture = np.full((720, 1280, 3), 255, np.uint8)
    for points, color in ((beams.world(corners) @ beams.UP, (0, 0, 200)), (flat, (0, 0, 0))):
        pixels = (points @ pose[:3, :3].T + pose[:3, 3]) @ beams.INTRINSICS.T
        hull = cv2.convexHull((pixels[:, :2] / pixels[:, 2:]).astype(np.float32))
        cv2.fillConvexPoly(picture, hull.astype(np.int32), color)
    names = [f"{name}__0.png" for name in ("h_e_c", "h_m_c", "h_em_c", "t_em_c")]
    for name in names:
        cv2.imwrite(str(folder / name), picture)
    (folder / "views.json").write_text(json.dumps({"all": {"images": dict.fromkeys(names, pose.tolist())}}))

    def short(*given: Any, options: dict[str, Any], **more: Any) -> Any:
        return minimize(*given, options=options | {"maxiter": 1}, **more)

    smaller: dict[str, Any] = {f"two_materials.{module}.minimize": short for module in ("make", "beams")}
    smaller |= {"two_materials.beams.CELLS": 2, "two_materials.make.STEPS": 1, "two_materials.make.VERTICES": 7}
    smaller |= {"two_materials.make.TURN": 10.0, "two_materials.make.RATIOS": (2.5,), "two_materials.make.SIZES": ()}
    # The second command resumes the first.
    commands = [["hanging", folder, folder / "out", "--rows", "uniform"]]
    return StandIn(commands + [[command, folder, folder / "out"] for command in ("hanging", "tables", "twisted")], smaller)


def of_foam(folder: Path) -> StandIn:
    """A cylinder that hangs at rest, rivals that predict it exactly, and a twin that was not fitted."""
    settings = parse(Config, read_yaml(ROOT / "config/data/foam.yaml"), "foam")
    places = {"p_b": (0.0, 0.0, 2.0), "phi_b": (0.0, 0.0, 0.0), "p_m": (0.897, 0.004, 1.819), "p_e": (1.857, 0.026, 1.626)}
    columns = {
        f"{name}_{axis}": np.full(61, value) for name, place in places.items() for axis, value in zip("xyz", place, strict=True)
    }
    for number in (1, 8):
        pd.DataFrame({"t": np.arange(61) / foam.RATE, **columns}).to_csv(folder / f"traj{number}.csv", index=False)
    (folder / "rivals").mkdir()
    windows = {26: "1 s", 51: "20 s"}
    for name in foam.RIVALS:
        seen = {f"{kind}_{axis}": columns[f"p_e_{axis}"] for kind in ("pe", "hat_pe") for axis in "xyz"}
        for window in windows:
            pd.DataFrame(seen).to_csv(folder / "rivals" / f"{name}_predictions_{window}steps.csv", index=False)
    run = folder / "results" / settings.scenarios[0] / "rod_slip" / "0"
    rod_twin(foam.observed(folder, 1, settings, 4), settings).save(run / "twin.npz")
    Recorder("fit", run / "fit.json").save({"twin": run / "twin.npz"})
    command = [folder, folder / "results", "--output", folder / "out", "--methods", "rod_slip"]
    return StandIn([command], {"foam.make.WINDOW": 51, "foam.make.WINDOWS": windows})


def sampled(folder: Path) -> Path:
    """Results of the sample scenario of the package."""
    shutil.copytree(sample_twin().parents[2], folder / "results")
    return folder / "results"


def synthesized(folder: Path) -> Path:
    """The same with a capture of noise and a truth that moves like the twin."""
    results, run = sampled(folder), RunFolder.of(sample_twin())
    assert run.trajectory is not None
    nodes, hands = run.trajectory.positions[:, ::20], run.observations.controller_points.mean(axis=1, keepdims=True)
    frames, count, tetrahedra = len(nodes), nodes.shape[1], Delaunay(nodes[0]).simplices
    none, still = np.zeros((0, 3), np.int32), np.zeros(frames, np.float32)
    home = results / sample_twin().parents[1].name
    Truth(
        nodes=nodes,
        tetrahedra=tetrahedra.astype(np.int32),
        triangles=none,
        youngs_modulus=np.linspace(1e4, 2e4, len(tetrahedra), dtype=np.float32),
        membrane=still[:0],
        surface_nodes=np.arange(count, dtype=np.int32)[:, None],
        surface_weights=np.ones((count, 1), np.float32),
        surface_faces=ConvexHull(nodes[0]).simplices.astype(np.int32),
        hand_poses=np.concatenate([hands, np.tile([0.0, 0, 0, 1], (frames, 1, 1))], axis=2).astype(np.float32),
        held=np.full(count, -1, np.int32),
        touches=np.zeros((frames, count), bool),
        kinetic=still,
        potential=still,
        least_jacobian=still + 1,
        substeps=1,
        certificate=0.0,
        sensitivity=0.0,
    ).save(truth_path(home / "capture"))
    provenance = {"truth": f"sha256:{digest_file(truth_path(home / 'capture'))}"}
    captures.write(home / "capture", captures.describe(name=home.name, frame_count=frames, provenance=provenance))
    return results


def of_cameras(folder: Path) -> StandIn:
    """A synthetic scene, and runs from three cameras and from one."""
    results, runs = synthesized(folder), folder / "runs"
    scenario = sample_twin().parents[1]
    for arm in ("three", "color"):
        shutil.copytree(scenario, runs / f"{scenario.name}_{arm}")
    return StandIn([["make", results, folder / "out"], ["table", folder / "out", runs, "--output", folder / "out" / "tables"]])


def of_scenes(folder: Path) -> StandIn:
    """The sample as one of the paper's scenes."""
    scenario = sample_twin().parents[1]
    shutil.copytree(scenario, folder / "results" / "single_lift_sloth_points")
    return StandIn([[folder / "results", "--output", folder / "out"]])


def of_hands(folder: Path) -> StandIn:
    """Thirty points of a hand that rises above a rope, its nodes and annotated points, in counts; up is -z."""
    rng, case = np.random.default_rng(0), folder / "single_lift_rope"
    case.mkdir()
    nodes = np.stack([np.arange(0, 3000, 50), np.zeros(60), np.full(60, -300)], axis=1).astype(int)
    hand = nodes[0] + rng.integers(-100, 100, (30, 3))
    for name, points in {"controller": hand, "landmarks": nodes[::7]}.items():
        rows = [[frame, *(points - [0, 0, 20 * frame]).ravel()] for frame in range(10)]
        np.savetxt(case / f"{name}.txt", rows, fmt="%d")
    np.savetxt(case / "rest.txt", nodes, fmt="%d")
    return StandIn([[folder, folder / "out"]])


def filmed(folder: Path) -> Path:
    """A video of six frames painted from the annotations of its case, and rivals that show the same."""
    data = folder / "phystwin22_films"
    for name in ("observation_30fps", "renders_25fps"):
        (data / name).mkdir(parents=True)
    table = np.random.default_rng(0).integers(140, 160, (362, 640, 3), np.uint8)
    shown = table.copy()
    for mark in films.marks_of(CASE, (640, 362)):
        color = (60, 120, 40) if mark.label == "object" else (120, 150, 220)
        cv2.fillPoly(shown, [np.array(mark.points, np.int32)], color)
    for name in ("observation_30fps", "renders_25fps"):
        video = cv2.VideoWriter(str(data / name / f"{CASE}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, (1920, 362))
        for _ in range(6):
            video.write(np.tile(shown, (1, 3, 1)))
        video.release()
    cv2.imwrite(str(data / "empty_table.png"), table)
    pd.DataFrame({"case": [CASE], "frames": ["0 1 2 3 4 5"]}).to_csv(data / "frame_map.csv", index=False)
    pose = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1]]
    camera = {"camera": 0, "K": [[430, 0, 424], [0, 430, 240], [0, 0, 1]], "camera_to_world": pose}
    (data / "cameras.json").write_text(json.dumps({"cameras": [camera]}))
    return data


def of_films(folder: Path) -> StandIn:
    """A video of a known case."""
    return StandIn([[filmed(folder), folder / "out"]])


def of_renders(folder: Path) -> StandIn:
    """The same with its capture, and a run without images."""
    films.write_captures(filmed(folder), folder / "work" / "captures", [CASE])
    run = folder / "work" / "results" / f"film_{CASE}" / "neuspring_wide" / "0"
    run.mkdir(parents=True)
    shutil.copy(sample_twin() / "run.json", run)
    return StandIn([[folder, folder / "work", "--cores", 0, "--output", folder / "out", "--strips", folder / "out"]])


def of_cloth(folder: Path) -> StandIn:
    """A sheet of 7 x 7 nodes that leans and does not move, and a prediction of size zero."""
    x, z = np.mgrid[:7, :7][::-1]
    states = np.stack([x, 0.1 * z, z]).reshape(147, 1)
    savemat(folder / "SOMtraj8_1_10ms.mat", {"SOMrec": {"states": np.tile(states, (2, 40))}})
    run = folder / "results" / "cloth_8_1" / "search_only" / "0"
    run.mkdir(parents=True)
    np.savez(run / "transfer_positions.npz", cloth_8_1=np.zeros((10, 42, 3)))
    captures = ["captures", folder, folder / "captures"]
    return StandIn([captures, ["tables", folder, folder / "out", "--results", folder / "results"]])


STAND_INS: dict[str, Callable[[Path], StandIn]] = {
    "beam.make": of_beam,
    "bench.__main__": lambda folder: StandIn([["--quick", "--only", "frame", "--device", "cpu"]], {"bench.table.ROOT": folder}),
    "bench.splats": lambda folder: StandIn([["--repeats", 1]], {"bench.splats.SIZES": ((53, 30),), "bench.splats.COUNTS": (100,)}),
    "bench.spring_gaus": lambda folder: StandIn([[]], {"bench.spring_gaus.REPEATS": 1}),
    "cloth.make": of_cloth,
    "film22.films": of_films,
    "film22.make": of_renders,
    "foam.make": of_foam,
    "identifiability.make": lambda folder: StandIn(
        [[folder / "out", "--epochs", 1, "--seeds", 0, "--scenes", "rope/shake/smooth", "--noises", 0.0005, "--jobs", 1]]
    ),
    "one_color_camera.make": of_cameras,
    "pictures.pulled": lambda folder: StandIn(
        [[folder / "pulled.gif"]], {"pictures.pulled.VIEW": ("--as", "nodes", *pulled.VIEW[2:])}
    ),
    "scenes.captures": of_hands,
    "scenes.make": of_scenes,
    "stiffness.make": lambda folder: StandIn([[synthesized(folder), folder / "out", "--pictures", sample_twin().parents[1].name]]),
    "synthetic.make": lambda folder: StandIn([[synthesized(folder), folder / "out"]]),
    "two_materials.make": of_silicones,
}
"""Script under results.published -> its substitute."""


def main() -> None:
    """Write a substitute and print its commands."""
    script, folder = sys.argv[1:]
    Path(folder).mkdir(parents=True)
    for command in STAND_INS[script](Path(folder)).commands:
        print("python -m", f"results.published.{script}", *command)


if __name__ == "__main__":
    main()
