"""A silicone beam under known loads: twins are fitted to the ring-down of the unloaded beam and predict the pose of the loaded tip.

    python -m results.published.beam.make FOLDER OUTPUT

FOLDER has C3D files whose names end in gravity_V2_NAME.c3d (unloaded) or load<grams>_V2_NAME.c3d, with markers `Tip - ...`. A hand
holds the beam and releases it; the beam oscillates and comes to rest. Only unloaded files are used for fits:

1. **Law.** z'' = -k (z + sum_i s_i (z - q_i)), q_i' = (z - q_i) / T_i, from the held state, is fitted to the tip heights of all
   files together. It is a linear viscoelastic solid with one branch per factor of 5 in time, from the inverse angular frequency
   of the oscillation to half of the recording. The result is sqrt(k) / 2 pi, the frequency of a beam with the relaxed modulus.
2. **Modulus.** The twin gets the modulus at which its first frequency equals this one. The force of the hand is not needed.
3. **Hand.** The twin's static pose under its weight, minus the observed change, is the pose in which the hand held the tip.

The prediction is the static pose under weight and load, minus the pose in which the hand held the unloaded tip; the markers rotate
with the tip. The frequency under load is that of the loaded twin, raised by the law. `static` in place of a twin is the usual
way: a lattice whose modulus explains the unloaded drop as if the hand held it without stress.

The twins are a lattice of nodes 5 mm apart (7.5 across in `lattice_coarse`), and a rod. Mass is the volume by 1070 kg/m^3, the load
is at the tip. Writes beam.csv (a row per recording and twin), law.csv (the fit to all and to each unloaded file) and beam.md.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from scipy.optimize import brentq, least_squares
from scipy.spatial.transform import Rotation

from neuspring.core.artifacts import Simulation, Twin
from neuspring.core.errors import InputError
from neuspring.core.table import Cell, Table
from neuspring.data.c3d import Markers
from neuspring.extensions.rods.rod import Rod
from neuspring.extensions.rods.solver import RodSolver
from neuspring.physics.parameters import homogeneous
from neuspring.physics.topology import build, object_springs
from neuspring.twin.body import body_of
from neuspring.twin.rollout import roll_out
from results.published.beam.statics import at_rest, young

NAME = re.compile(r"(?:gravity|load(?P<grams>\d+))_V2_(?P<take>\w+)\.c3d")
LENGTH, WIDTH, DENSITY, GRAVITY = 0.1, 0.03, 1070.0, 9.81
"""m, m, kg/m^3, m/s^2."""
MASS = DENSITY * LENGTH * WIDTH**2
AXES = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""Rotation from the axes of the data (up, across, along) to ours (along the beam, across, up)."""
FELL = 0.0005
"""Fall of the tip that counts as the release, m."""
BEFORE, LAST = 3, 50
"""Frames before the release that are excluded because the beam moves; last frames that are averaged for the pose at rest."""
BRANCHES = np.array([0.02, 0.1, 0.5, 2.5])
"""T_i: time constants of the branches, s."""
REACH = 1.5
"""Largest spring length in spacings: 18 neighbors, six along the axes and twelve along face diagonals."""
CONTACTS = {"ground_elasticity": 0.0, "ground_friction": 0.0, "contact_elasticity": 0.0, "contact_friction": 0.0}
WEAK = 1e-2
"""Fraction of gravity for frequencies: small oscillations about a straight beam."""
ACROSS = {"lattice": 6, "lattice_coarse": 4}
"""Nodes across of each lattice."""
VERTICES = 21


@dataclass(frozen=True)
class Recording:
    """A released beam: markers of its tip [T, 3, 3], m, x along the beam and z up."""

    take: str
    load: float
    """kg"""
    tip: np.ndarray
    rate: float

    @classmethod
    def read(cls, path: Path) -> Recording:
        found = NAME.search(path.name)
        assert found is not None, "asked for by this name"
        markers = Markers.read(path)
        own = [k for k, label in enumerate(markers.labels) if label.startswith("Tip")]
        tip = markers.points[:, own].reshape(len(markers.points), -1)
        if lost := int(np.isnan(tip).sum() / 3):
            print(f"{path.name}: {lost} missing marker positions are interpolated linearly.")
            tip = pd.DataFrame(tip).interpolate(limit_direction="both").to_numpy()
        return cls(found["take"], float(found["grams"] or 0) / 1e3, tip.reshape(len(tip), -1, 3) @ AXES.T, markers.rate)

    @property
    def height(self) -> np.ndarray:
        """Mean height of the markers above rest [T], m."""
        z = self.tip[:, :, 2].mean(axis=1)
        return np.asarray(z - z[-LAST:].mean())

    @property
    def released(self) -> int:
        """First frame in which the tip falls."""
        z = self.height
        return int(np.argmax(z < np.median(z[:20]) - FELL))

    @property
    def start(self) -> np.ndarray:
        """Markers while the hand holds the beam [3, 3], m."""
        return np.asarray(self.tip[self.released // 2 : self.released - BEFORE].mean(axis=0))

    @property
    def end(self) -> np.ndarray:
        """Markers at rest [3, 3], m."""
        return np.asarray(self.tip[-LAST:].mean(axis=0))

    @property
    def change(self) -> np.ndarray:
        """Change of the tip's pose from hand to rest: along, up [m], rotation about the cross axis [rad], down positive."""
        start, end = self.start - self.start.mean(axis=0), self.end - self.end.mean(axis=0)
        turn = Rotation.align_vectors(end, start)[0].as_rotvec()[1]
        return np.append((self.end - self.start).mean(axis=0)[[0, 2]], turn)


@dataclass(frozen=True)
class Law:
    """Relaxation of the material: branches with s_i times the relaxed stiffness."""

    relaxed: float
    """Hz"""
    shares: np.ndarray
    residual: float
    """m, RMS"""

    def complex(self, frequency: float) -> complex:
        """Complex stiffness at a frequency [Hz] over the relaxed stiffness."""
        w = 2j * np.pi * frequency * BRANCHES
        return complex(1 + (self.shares * w / (1 + w)).sum())

    def rings(self, relaxed: float) -> tuple[float, float]:
        """Frequency [Hz] and logarithmic decrement of an object whose frequency is `relaxed` with the relaxed stiffness."""
        found = brentq(lambda f: f**2 - relaxed**2 * self.complex(f).real, relaxed, 2 * relaxed)
        stiffness = self.complex(found)
        return float(found), float(np.pi * stiffness.imag / stiffness.real)


def motion(stiffness: float, shares: np.ndarray, times: np.ndarray) -> np.ndarray:
    """z [T] at times [T] [s] after a release from equilibrium at z = 1; 1 before the release."""
    count = len(shares)
    matrix = np.zeros((2 + count, 2 + count))
    matrix[0, 1], matrix[1, 0], matrix[1, 2:] = 1.0, -stiffness * (1 + shares.sum()), stiffness * shares
    matrix[2:, 0], matrix[2:, 2:] = 1 / BRANCHES, -np.diag(1 / BRANCHES)
    values, vectors = np.linalg.eig(matrix)
    held = np.ones(2 + count)
    held[1] = 0.0
    parts = vectors[0] * np.linalg.solve(vectors, held.astype(complex))
    return np.asarray((np.exp(np.maximum(times, 0.0)[:, None] * values) @ parts).real)


def fit_law(recordings: Sequence[Recording]) -> Law:
    """Least squares over all heights after the release; each recording has its own release time, held height and final height."""
    count = len(BRANCHES)

    def residuals(p: np.ndarray) -> np.ndarray:
        rows = []
        for recording, (late, held, rest) in zip(recordings, p[1 + count :].reshape(-1, 3), strict=True):
            times = np.arange(-1, len(recording.height) - recording.released) / recording.rate - late
            rows.append(
                held * motion(np.exp(p[0]), np.exp(p[1 : 1 + count]), times) + rest - recording.height[recording.released - 1 :]
            )
        return np.concatenate(rows)

    own = [value for recording in recordings for value in (-1 / recording.rate, recording.height[recording.released - BEFORE], 0.0)]
    start = np.concatenate([[2 * np.log(2 * np.pi * _ringing(recordings[0])[0])], np.log(np.full(count, 0.05)), own])
    scale = np.concatenate([np.full(1 + count, 0.1), np.tile([1e-3, 1e-4, 1e-4], len(recordings))])
    found = least_squares(residuals, start, x_scale=scale)
    residual = float(np.sqrt(np.mean(found.fun**2)))
    return Law(float(np.exp(found.x[0] / 2) / (2 * np.pi)), np.exp(found.x[1 : 1 + count]), residual)


def _ringing(recording: Recording, skip: int = 15, frames: int = 150) -> tuple[float, float]:
    """Frequency [Hz] and logarithmic decrement: a damped cosine on a logarithmic drift, by least squares."""
    z = recording.height[recording.released + skip :][:frames]
    times = (np.arange(len(z)) + skip + 1) / recording.rate
    return ring(z, times, np.log(times))


def ring(z: np.ndarray, times: np.ndarray, *drift: np.ndarray) -> tuple[float, float]:
    """Frequency [Hz] and logarithmic decrement of heights z [T] at times [T] [s], with a constant and drift terms."""
    spectrum = np.abs(np.fft.rfft((z - z.mean()) * np.hanning(len(z)), 16 * len(z)))
    first = np.fft.rfftfreq(16 * len(z), times[1] - times[0])[spectrum.argmax()]

    def residuals(p: np.ndarray) -> np.ndarray:
        fading = np.exp(-p[1] * times)
        terms = np.stack([fading * np.cos(p[0] * times), fading * np.sin(p[0] * times), np.ones_like(times), *drift], axis=1)
        return np.asarray(terms @ np.linalg.lstsq(terms, z, rcond=None)[0] - z)

    w, fading = least_squares(residuals, [2 * np.pi * first, 0.0]).x
    return float(w / (2 * np.pi)), float(2 * np.pi * fading / w)


def lattice(across: int, load: float, modulus: float = 1e5) -> Twin:
    """A block of nodes with equal springs and this modulus along it [Pa] (`statics.young`); its controllers are in the clamp.

    A node represents the material around it, so the last layer along the beam has half of the mass, and the load.
    """
    spacing = WIDTH / across
    along = np.linspace(0.0, LENGTH, round(LENGTH / spacing) + 1)
    side = (np.arange(across) - (across - 1) / 2) * spacing
    grid = np.stack(np.meshgrid(along, side, side, indexing="ij"), axis=-1)
    held, free = grid[0].reshape(-1, 3), grid[1:].reshape(-1, 3)
    points = np.concatenate([free, held])
    pairs = np.sort(object_springs(points, np.full(len(points), REACH * max(spacing, along[1])), np.full(len(points), 27)), axis=1)
    of_clamp = pairs[:, 1] >= len(free)
    pairs = np.concatenate([pairs[~of_clamp], pairs[of_clamp & (pairs[:, 0] < len(free))]])
    mass = np.full(len(free), DENSITY * along[1] * spacing**2)
    mass[-(across**2) :] /= 2
    values = CONTACTS | {"stiffness": 1.0, "dashpot": 0.0, "drag": 0.0, "contact_distance": spacing}
    simulation = Simulation(frame_time=0.01, substeps=1, gravity=GRAVITY, ground=False)
    material = replace(homogeneous(values, len(pairs)), mass=mass)
    twin = Twin(topology=build(free, held, pairs), material=material, simulation=simulation)
    own = young(twin, DENSITY)[0]
    mass[-(across**2) :] += load / across**2
    return replace(twin, material=replace(material, stiffness=material.stiffness * (modulus / own), mass=mass))


class Beam(ABC):
    """A kind of twin of the beam."""

    @abstractmethod
    def static(self, modulus: float, load: float) -> np.ndarray:
        """Change of the tip's pose from the undeformed shape, like `Recording.change`."""

    @abstractmethod
    def frequency(self, load: float) -> float:
        """First frequency at 1e5 Pa [Hz]; it is proportional to the square root of the modulus."""


class LatticeBeam(Beam):
    """Springs of equal stiffness."""

    def __init__(self, across: int) -> None:
        self.across = across

    def static(self, modulus: float, load: float) -> np.ndarray:
        twin = lattice(self.across, load, modulus)
        before, after = (each.topology.nodes[-(self.across**2) :].astype(np.float64) for each in (twin, at_rest(twin)))
        centers = before.mean(axis=0), after.mean(axis=0)
        turn = Rotation.align_vectors(after - centers[1], before - centers[0])[0].as_rotvec()[1]
        return np.append((centers[1] - centers[0])[[0, 2]], turn)

    def frequency(self, load: float) -> float:
        twin = lattice(self.across, load)
        twin = replace(twin, simulation=replace(twin.simulation, gravity=WEAK * GRAVITY))
        twin = body_of(twin).stable(twin, 0.5)
        path = roll_out(twin, np.repeat(twin.topology.controllers[None], 100, axis=0)).positions
        z = path[:, -(self.across**2) :, 2].mean(axis=1)
        return ring(z.astype(np.float64), np.arange(100) * twin.simulation.frame_time)[0]


class RodBeam(Beam):
    """The elastic rod, without shear and rotational inertia of sections. The clamp holds the middle of its edge."""

    def _rod(self, modulus: float, load: float) -> Rod:
        edge = LENGTH / (VERTICES - 1.5)
        vertices = np.zeros((VERTICES, 3))
        vertices[:, 0] = (np.arange(VERTICES) - 0.5) * edge
        mass = np.full(VERTICES, MASS / LENGTH * edge)
        mass[-1] = mass[-1] / 2 + load
        inertia = np.full(VERTICES, WIDTH**4 / 12)
        return Rod(
            vertices=vertices,
            held=np.where(np.arange(VERTICES) < 2, np.arange(VERTICES), -1).astype(np.int32),
            lengths=np.full(VERTICES - 1, edge),
            mass=mass,
            bending=modulus * inertia,
            twisting=modulus * inertia / 2,
            curvature=np.zeros((VERTICES, 2)),
            stretching=modulus * WIDTH**2,
            damping=0.0,
            drag_quadratic=0.0,
            roll=0.0,
            axis=np.array([0.0, 1.0, 0.0]),
            edge=np.zeros(0, np.int32),
            place=np.zeros((0, 3)),
        )

    def _solver(self, modulus: float, load: float, simulation: Simulation) -> tuple[RodSolver, torch.Tensor]:
        rod = self._rod(modulus, load)
        x = torch.tensor(rod.vertices)[None]
        solver = RodSolver([rod], [0.0], simulation)
        solver.start(x, torch.zeros_like(x))
        return solver, x

    def static(self, modulus: float, load: float) -> np.ndarray:
        # A long step of backward Euler from rest is a Newton step towards the equilibrium.
        simulation = Simulation(frame_time=0.1, substeps=1, gravity=GRAVITY, ground=False)
        solver, x = self._solver(modulus, load, simulation)
        for _ in range(100):
            solver.frame(x, x)
            solver.start(solver.x.clone(), torch.zeros_like(x))
        line = solver.x[0].numpy()
        edge = line[-1] - line[-2]
        moved = line[-1] - x[0, -1].numpy()
        return np.array([moved[0], moved[2], np.arctan2(-edge[2], edge[0])])

    def frequency(self, load: float) -> float:
        simulation = Simulation(frame_time=0.01, substeps=20, gravity=WEAK * GRAVITY, ground=False)
        solver, x = self._solver(1e5, load, simulation)
        z = [0.0]
        for _ in range(99):
            solver.frame(x, x)
            z.append(float(solver.x[0, -1, 2]))
        return ring(np.array(z), np.arange(100) * 0.01)[0]


KINDS: dict[str, Beam] = {**{name: LatticeBeam(across) for name, across in ACROSS.items()}, "rod": RodBeam()}


def predictor(beam: Beam, modulus: float, hand: np.ndarray) -> Callable[[Recording], np.ndarray]:
    """Predictor of the markers at rest [3, 3], m, of a recording whose tip was held in the pose `hand`."""

    def predict(recording: Recording) -> np.ndarray:
        along, up, turn = beam.static(modulus, recording.load) - hand
        center = recording.start.mean(axis=0)
        turned = Rotation.from_rotvec([0.0, turn, 0.0]).apply(recording.start - center)
        return np.asarray(center + turned + [along, 0.0, up])

    return predict


def measured(recording: Recording, twin: str, modulus: float, end: np.ndarray, rings: tuple[float, float]) -> dict[str, object]:
    """A row of the table, with observed and predicted values."""
    drop = [float((recording.start - pose)[:, 2].mean()) for pose in (recording.end, end)]
    seen = _ringing(recording)
    row = {"twin": twin, "load": recording.load, "take": recording.take, "modulus": modulus, "drop": drop[0], "predicted": drop[1]}
    row |= {"error": drop[1] / drop[0] - 1, "markers": float(np.linalg.norm(end - recording.end, axis=1).mean())}
    return row | {"frequency": seen[0], "rings": rings[0], "decrement": seen[1], "fades": rings[1]}


def main() -> None:
    """Fit to the unloaded files of a folder and predict all files."""
    parser = ArgumentParser(description=__doc__.split("\n")[0])  # type: ignore[union-attr]
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    given = parser.parse_args()
    paths = sorted(path for path in given.folder.glob("*.c3d") if NAME.search(path.name))
    recordings = [Recording.read(path) for path in paths]
    plain = [recording for recording in recordings if not recording.load]
    if not plain:
        raise InputError(given.folder, "must contain a file *gravity_V2_*.c3d", [path.name for path in paths])
    law = fit_law(plain)
    laws = {"all": law} | {recording.take: fit_law([recording]) for recording in plain}
    observed = np.mean([recording.change for recording in plain], axis=0)
    rows = []
    for name, beam in KINDS.items():
        modulus = 1e5 * (law.relaxed / beam.frequency(0.0)) ** 2
        predict = predictor(beam, modulus, beam.static(modulus, 0.0) - observed)
        for recording in recordings:
            relaxed = beam.frequency(recording.load) * np.sqrt(modulus / 1e5)
            rows.append(measured(recording, name, modulus, predict(recording), law.rings(relaxed)))
    usual, nothing = KINDS["lattice"], np.zeros(3)
    modulus = brentq(lambda e: usual.static(e, 0.0)[1] - observed[1], 1e5, 1e6, xtol=10)
    predict = predictor(usual, modulus, nothing)
    for recording in recordings:
        rows.append(
            measured(
                recording, "static", modulus, predict(recording), (usual.frequency(recording.load) * np.sqrt(modulus / 1e5), 0.0)
            )
        )
    given.output.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame(rows)
    table.to_csv(given.output / "beam.csv", index=False, float_format="%.6g")
    fits = pd.DataFrame(
        [
            {"takes": takes, "relaxed": each.relaxed, **{f"share_{t:g}": s for t, s in zip(BRANCHES, each.shares, strict=True)}}
            | {"stiffer": each.complex(each.rings(each.relaxed)[0]).real, "residual": each.residual}
            for takes, each in laws.items()
        ]
    )
    fits.to_csv(given.output / "law.csv", index=False, float_format="%.6g")
    text = "\n".join(shown(table).markdown()) + "\n"
    (given.output / "beam.md").write_text(text)
    print(fits.to_string(), text, sep="\n\n")


def shown(table: pd.DataFrame) -> Table:
    """The table of beam.md."""
    header = [
        "twin",
        "load, g",
        "take",
        "E at rest, kPa",
        "drop seen, mm",
        "predicted",
        "error",
        "markers, mm",
        "Hz seen",
        "predicted",
    ]
    forms = {"load": (1e3, ".0f"), "take": None, "modulus": (1e-3, ".0f"), "drop": (1e3, ".2f"), "predicted": (1e3, ".2f")}
    forms |= {"error": (100, "+.1f"), "markers": (1e3, ".2f"), "frequency": (1, ".2f"), "rings": (1, ".2f")}
    rows = []
    for row in table.to_dict("records"):
        cells = [str(row["twin"])]
        cells += [str(row[key]) if form is None else f"{form[0] * row[key]:{form[1]}}" for key, form in forms.items()]
        cells[6] += " %"
        rows.append([Cell(text=cell) for cell in cells])
    return Table(header=header, rows=rows)


if __name__ == "__main__":
    main()
