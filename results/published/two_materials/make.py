"""Stiffness from silhouettes of beams of one and of two silicones with a known ratio (data of DiffCal, CGF 2023).

    python -m results.published.two_materials.make hanging DATA OUT [--rows ...]       # fits, one row of OUT/fits.csv each
    python -m results.published.two_materials.make tables DATA OUT                     # OUT/summary.md, OUT/stiffness.png
    python -m results.published.two_materials.make twisted FOLDER OUT [--cad DATA/cad] [--pictures "t_em_c__*.png"]

DATA contains images/, views.json and cad/ of the beams; FOLDER contains images of twisted beams and their views.json. `twisted`
predicts with the fits of `hanging` in OUT; OUT/twisted.csv has a row per prediction, OUT/twisted.md the means.

The beam is a lattice whose planes meet the faces of the beam; its surface is that of the CAD file. Newton's method finds the
equilibrium (a damped rollout of the simulator agrees within 1e-3 mm); gradients follow from the balance of forces. The loss is
the term `silhouette` of the package, in squared pixels. The pose of an image is computed from its marker's corners, because poses
in views.json differ by 1 to 30 degrees for a fixed camera. It is fitted together with the stiffness, with a deviation of 0.3
pixels for corners.
"""

from __future__ import annotations

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch
from matplotlib import pyplot as plt
from scipy.optimize import minimize

from neuspring import config
from neuspring.core.artifacts import Simulation, Twin
from neuspring.core.files import write_text
from neuspring.core.table import Table
from neuspring.extensions.rods.nodes import RodFrames, bound
from neuspring.extensions.rods.rod import Rod
from neuspring.physics.parameters import homogeneous
from neuspring.physics.topology import build
from neuspring.twin.parameters import TwinParameters
from results.published.two_materials.beams import (
    CELLS,
    CM,
    DENSITY,
    GRAVITY,
    HALF,
    HEAD,
    THICK,
    Beam,
    Equilibrium,
    Held,
    View,
    posed,
    views_of,
    world,
)

TRUTH = 2.5


class Found(dict[str, Any]):
    """A row of fits.csv, with stiffness of springs or modulus of joints by position, and the predicted surface."""

    place: np.ndarray
    """x of springs or joints [S], cm."""
    stiffness: np.ndarray
    """Stiffness [S], N, or modulus, Pa."""
    surface: np.ndarray
    q: np.ndarray

    @classmethod
    def of(cls, view: View, loss: float, place: np.ndarray, values: np.ndarray, surface: np.ndarray, q: np.ndarray) -> Found:
        """The row of a fit, with geometric means between the heads."""
        logs, between = np.log(values), np.abs(place) < HEAD
        left, right = between & (place < 0), between & (place > 0)
        means = logs[left].mean(), logs[right].mean()
        spread = logs[between].std() > 1e-6
        related = np.corrcoef(logs[between], place[between] < 0)[0, 1] if spread else np.nan
        row = cls(loss=loss, ratio=np.exp(means[0] - means[1]), correlation=related, left=np.exp(means[0]), right=np.exp(means[1]))
        row |= view.scores(surface, q) | {f"q{k}": value for k, value in enumerate(q)}
        row.place, row.stiffness, row.surface, row.q = place, values, surface, q
        return row


UNIT = 0.1
"""Change of log stiffness with the same scale as a degree or a millimeter of the pose."""
Law = Callable[[torch.Tensor], torch.Tensor]
"""Maps variables [P] to log stiffness [S]."""


def descended(view: View, held: Held, law: Law, start: Sequence[float], q: np.ndarray) -> tuple[np.ndarray, Found]:
    """Fit variables and pose by L-BFGS from `start` [P] and q [6]; it ends at small steps, where nearest points change."""
    count = len(start)

    def value(p: np.ndarray) -> tuple[float, np.ndarray]:
        free = torch.tensor(p, requires_grad=True)
        loss = view.of_nodes(Equilibrium.apply(law(UNIT * free[:count]).exp(), held), free[count:])
        loss.backward()
        return loss.item(), free.grad.numpy()

    held.x = held.rest
    first = np.concatenate([np.array(start) / UNIT, q])
    limits = [(np.log(0.3) / UNIT, np.log(60) / UNIT)] * min(count, 2) + [(-6 / UNIT, 6 / UNIT)] * (count - 2) + [(None, None)] * 6
    best = minimize(value, first, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 80, "ftol": 1e-5})
    stiffness = law(torch.tensor(UNIT * best.x[:count])).exp()
    surface = held.beam.carried @ held.settle(stiffness.numpy())
    found = Found.of(view, best.fun, held.beam.middles[held.kept, 0], stiffness.numpy(), surface, best.x[count:])
    return UNIT * best.x[:count], found


def uniform(held: Held) -> Law:
    """One stiffness for all springs."""
    return lambda p: p[0].expand(len(held.kept))


def regional(held: Held, boundary: float | None = 0.0) -> Law:
    """Two stiffnesses, on both sides of `boundary` [cm] along the beam; None: the boundary is the third variable."""
    x = torch.tensor(held.beam.middles[held.kept, 0])
    width = 2 * THICK / CELLS

    def law(p: torch.Tensor) -> torch.Tensor:
        part = ((x - (p[2] if boundary is None else boundary)) / width + 0.5).clamp(0, 1)
        return p[0] + (p[1] - p[0]) * part

    return law


STEPS = 120
"""Steps of Adam; the loss is constant after them."""


def trained(view: View, held: Held, kind: str, seed: int, start: float, q: np.ndarray) -> Found:
    """Fit a value per spring or a field by Adam, with the settings for ten frames, from a uniform stiffness [N]."""
    field = config.SpringFieldSettings(shuffled=kind == "shuffled", plane_learning_rate=0.01)
    rate = 0.03 if kind == "springs" else 0.001
    settings = config.Fit(learning_rate=rate, factor_learning_rate=0.01, output_bound=1.5, global_stiffness=True, field=field)
    twin = replace(held.twin, material=replace(held.twin.material, stiffness=np.full(len(held.kept), start)))
    parameters = TwinParameters(twin, settings, "springs" if kind == "springs" else "field", "cpu", seed)
    pose = torch.tensor(q, requires_grad=True)
    optimizer = torch.optim.Adam([*parameters.groups(), {"params": [pose], "lr": 0.05}], betas=(0.9, 0.99), eps=1e-15)
    held.x, best = held.rest, (np.inf, np.empty(0), q, np.empty(0))
    for _ in range(STEPS):
        optimizer.zero_grad()
        stiffness = parameters.physical()["stiffness"]
        nodes = Equilibrium.apply(stiffness, held)
        loss = view.of_nodes(nodes, pose)
        if loss.item() < best[0]:
            best = loss.item(), stiffness.detach().double().numpy(), pose.detach().numpy().copy(), nodes.detach().numpy()
        loss.backward()
        optimizer.step()
    loss_, values, q, nodes_ = best
    return Found.of(view, loss_, held.beam.middles[held.kept, 0], values, held.beam.carried @ nodes_, q)


VERTICES, KNOTS = 21, np.array([-7.0, -3.5, 0.0, 3.5, 7.0])
"""Vertices of the rod; positions of its knots, cm."""
STEP = 0.002
"""Step of finite differences in the log of a modulus."""
ROOT = 0.5
"""Position of the rod's clamp behind the face of the head, cm, chosen on the beams of one material (a head deforms)."""


def rods(beam: Beam, moduli: np.ndarray) -> torch.Tensor:
    """Surfaces in equilibrium [B, P, 3], m, of rods with moduli exp(moduli) [B, 5], Pa, at the knots."""
    edge = (HEAD + ROOT + HALF) / (VERTICES - 1.5)
    x = HEAD + ROOT + edge * (0.5 - np.arange(VERTICES))
    height = 2 * THICK * np.where(np.abs(x) > HEAD, 2.0, 1.0)
    vertices = world(np.stack([x, 0 * x, 0 * x], axis=1))
    numbers = dict.fromkeys(
        ("ground_elasticity", "ground_friction", "contact_elasticity", "contact_friction", "dashpot", "stiffness"), 0.0
    )
    material = homogeneous(numbers | {"drag": 8.0, "contact_distance": 1e-3}, 0)
    nodes, hands = world(beam.surface), vertices[:2]
    spans = np.convolve(np.full(VERTICES - 1, edge * CM), [0.5, 0.5])
    twins = []
    for logs in moduli:
        bending = np.exp(np.interp(x, KNOTS, logs)) * 2 * THICK * height**3 / 12 * CM**4
        rod = Rod(
            vertices=vertices,
            held=np.where(np.arange(VERTICES) < 2, np.arange(VERTICES), -1),
            lengths=np.full(VERTICES - 1, edge * CM),
            mass=DENSITY * 2 * THICK * height * CM**2 * spans,
            bending=bending,
            twisting=bending,
            curvature=np.zeros((VERTICES, 2)),
            stretching=float(np.exp(logs.mean())) * (2 * THICK * CM) ** 2,
            damping=0.05,
            drag_quadratic=0.0,
            roll=0.0,
            axis=np.array([0.0, 1.0, 0.0]),
            edge=np.zeros(0, np.int32),
            place=np.zeros((0, 3)),
        )
        topology = build(nodes, hands, np.zeros((0, 2), np.int32))
        simulation = Simulation(frame_time=0.5, substeps=100, gravity=GRAVITY, ground=False)
        twins.append(Twin(topology=topology, material=material, simulation=simulation, body=bound(rod, nodes)))
    solver, paths = RodFrames(twins), torch.tensor(np.stack([hands] * len(twins)), dtype=torch.float32)
    state = torch.tensor(np.stack([nodes] * len(twins)), dtype=torch.float32)
    state, speed = state, torch.zeros_like(state)
    for _ in range(8):
        state, speed = solver.forward(state, speed, paths, paths)
    return solver.nodes()[0]


def of_rod(view: View, start: np.ndarray, q: np.ndarray, *, even: bool) -> Found:
    """Fit a rod with one modulus or one per knot; finite differences, all rods in one batch."""
    directions = np.ones((1, len(KNOTS))) if even else np.eye(len(KNOTS))
    shown = view.shown

    def value(p: np.ndarray) -> tuple[float, np.ndarray]:
        base, free = start + UNIT * p[:-6] @ directions, torch.tensor(p[-6:], requires_grad=True)
        surfaces = rods(view.beam, np.stack([base, *(base + STEP * d for d in directions)]))[:, shown]
        losses = [view.loss(surface, free) for surface in surfaces]
        losses[0].backward()
        slopes = [(other.item() - losses[0].item()) / STEP * UNIT for other in losses[1:]]
        return losses[0].item(), np.concatenate([slopes, free.grad.numpy()])

    best = minimize(
        value, np.concatenate([np.zeros(len(directions)), q]), jac=True, method="L-BFGS-B", options={"maxiter": 60, "ftol": 1e-5}
    )
    logs = start + UNIT * best.x[:-6] @ directions
    place = np.linspace(-HEAD, HEAD, 57)
    surface = rods(view.beam, logs[None])[0].numpy()
    return Found.of(view, best.fun, place, np.exp(np.interp(place, KNOTS, logs)), surface, best.x[-6:])


BEAMS = {"h_e_c": ("Ecoflex", 1.8), "h_m_c": ("MoldStar", 4.8), "h_em_c": ("both", 2.2)}
"""Experiment -> material, and initial stiffness, N."""
PER_SPRING = ("springs", "field", "shuffled")
"""Methods with a stiffness per spring."""
RATIOS = (1.5, 2.0, 2.5, 3.5, 6.0)
"""Ratios at which the loss is evaluated."""


def young_per_newton(beam: Beam) -> float:
    """Young's modulus, Pa, of a beam that sags as much as one with springs of 1 N, by M / EI and V / (5/6 GA)."""
    stiff, held = 1e3, Held(beam, beam.nodes[:, 0] > HEAD - 0.1)
    line = (np.abs(beam.nodes[:, 1:]).max(axis=1) < 1e-6) & (np.abs(beam.nodes[:, 0] + HEAD) < 1e-6)
    sag = (world(beam.nodes) - held.settle(np.full(len(held.kept), stiff)))[line, 2].item()
    x = np.linspace(-HALF, HEAD, 3401) * CM
    step, height = x[1] - x[0], 2 * THICK * CM * np.where(np.abs(x) > HEAD * CM, 2.0, 1.0)
    shear = np.cumsum(GRAVITY * DENSITY * 2 * THICK * CM * height) * step
    moment, area = np.cumsum(shear) * step, 2 * THICK * CM * height
    bent = moment / (area * height**2 / 12) * (x + HEAD * CM) + shear / (5 / 6 * area / 3)
    return float(bent[x > -HEAD * CM].sum() * step / sag / stiff)


def hanging(data: Path, out: Path, cad: Path, only: Sequence[str]) -> None:
    """Make all fits that are missing in OUT/fits.csv. OUT/springs has the stiffness of `PER_SPRING` methods, N."""
    beam = Beam(cad)
    held, path = Held(beam, beam.clamps[0]), out / "fits.csv"
    done: list[dict[Hashable, Any]] = pd.read_csv(path, dtype={"start": str}).to_dict("records") if path.exists() else []
    for name, (_, first) in BEAMS.items():
        for number, view in enumerate(views_of(beam, data, f"{name}__*.png")):
            even = pd.DataFrame([line for line in done if line["row"] == "uniform"], columns=["beam", "left"])
            for row, start, fit in rows_of(view, held, name, first, number, even.groupby("beam")["left"].mean()):
                keys: dict[Hashable, Any] = {"beam": name, "picture": number, "row": row, "start": start}
                if any(keys.items() <= line.items() for line in done) or (only and row not in only):
                    continue
                found = fit()
                line = {**keys, **found}
                along = pd.DataFrame({"x": found.place.round(), "y": np.log(found.stiffness)}).groupby("x")["y"].mean()
                table = pd.DataFrame({**keys, "x": along.index, "stiffness": np.exp(along.to_numpy())})
                table.to_csv(out / "along.csv", mode="a", header=not (out / "along.csv").exists(), index=False, float_format="%.4g")
                if row in PER_SPRING:
                    every = np.full(len(beam.springs), np.nan, np.float32)
                    every[held.kept] = found.stiffness
                    (out / "springs").mkdir(exist_ok=True)
                    np.save(out / "springs" / f"{name}_{number}_{row}_{start}.npy", every)
                done.append(line)
                pd.DataFrame(done).to_csv(path, index=False, float_format="%.5g")
                print({k: v if isinstance(v, str) else round(float(v), 3) for k, v in line.items()}, flush=True)


def rows_of(
    view: View, held: Held, name: str, first: float, number: int, alone: pd.Series
) -> list[tuple[str, str, Callable[[], Found]]]:
    """Fits of an image: method, start or seed, and function. `alone`: stiffness of beams of one material, by name."""
    still, log = np.zeros(6), float(np.log(first))
    even, known = uniform(held), regional(held)

    def low(law: Law, *start: float) -> Callable[[], Found]:
        return lambda: descended(view, held, law, start, still)[1]

    def to_boundary(start: float) -> Found:
        p, found = descended(view, held, regional(held, None), [log + 0.3, log - 0.3, start], still)
        found["boundary"] = p[2]
        return found

    rows = [("uniform", "0", low(even, log))]
    if number == 0:
        rows.append(("rod_uniform", "0", lambda: of_rod(view, np.full(len(KNOTS), log + np.log(6e4)), still, even=True)))
    if name != "h_em_c":
        return rows
    rows += [
        ("regions", f"ratio {r}", low(known, log + np.log(r) / 2, log - np.log(r) / 2))
        for r in (1.0, 4.0)[: 2 if number == 0 else 1]
    ]
    part = (torch.tensor(held.beam.middles[held.kept, 0]) < 0).double()
    if {"h_e_c", "h_m_c"} <= set(alone.index):
        made = torch.tensor(np.log(alone[["h_m_c", "h_e_c"]].to_numpy()))
        rows.append(("predicted", "0", low(lambda p: made[0] * part + made[1] * (1 - part))))
    if number:
        return [*rows, *((kind, "0", lambda kind=kind: from_uniform(view, held, kind, 0, log)) for kind in ("springs", "field"))]
    rows += [("regions_sought", f"boundary {b}", lambda b=b: to_boundary(b)) for b in (-3.0, 0.0, 3.0)]
    for ratio in RATIOS:
        law = lambda p, ratio=ratio: p[0] + np.log(ratio) * part  # noqa: E731
        rows.append(("given_ratio", f"{ratio}", low(law, log - np.log(ratio) / 4)))
    for kind in PER_SPRING:
        for seed in range(1 if kind == "springs" else 3):
            rows.append((kind, str(seed), lambda kind=kind, seed=seed: from_uniform(view, held, kind, seed, log)))
    rows.append(("rod", "0", lambda: of_rod(view, np.full(len(KNOTS), log + np.log(6e4)), still, even=False)))
    return rows


def from_uniform(view: View, held: Held, kind: str, seed: int, log: float) -> Found:
    """Fit springs or a field from the best uniform stiffness and its pose."""
    p, found = descended(view, held, uniform(held), [log], np.zeros(6))
    return trained(view, held, kind, seed, float(np.exp(p[0])), found.q)


TURN = 180.0
"""Rotation of the second clamp about x, degrees, as in the authors' simulation; its sign is from the edges in t_e_c."""
DRAWN = 10.0
"""Rotation per step towards `TURN`, degrees."""


class Twisted(Held):
    """A beam between two clamps; the second rotates about the beam's axis and moves along it."""

    folded = 0.0

    def __init__(self, beam: Beam) -> None:
        super().__init__(beam, beam.clamps[0] | beam.clamps[1])
        self._turn = self._shift = 0.0

    def twist(self, turn: float, shift: float, stiffness: np.ndarray) -> np.ndarray:
        """All nodes in equilibrium [N, 3], m, with the second clamp rotated by `turn`, degrees, and moved away by `shift`, mm."""
        count = max(int(np.ceil(max(abs(turn - self._turn) / DRAWN, abs(shift - self._shift) / 2))), 1)
        for part in np.linspace(0, 1, count + 1)[1:]:
            angle = np.radians(self._turn + part * (turn - self._turn))
            points = self.beam.nodes[self.held]
            c, s, far = np.cos(angle), np.sin(angle), points[:, 0] < 0
            y, z = points[far, 1], points[far, 2]
            moved = np.stack(
                [points[far, 0] - 0.1 * (self._shift + part * (shift - self._shift)), c * y - s * z, s * y + c * z], axis=1
            )
            self.hands = self.hands.copy()
            self.hands[far] = world(moved)
            nodes = self.settle(stiffness)
        self._turn, self._shift = turn, shift
        return nodes


def twisted(folder: Path, out: Path, cad: Path, pattern: str) -> None:
    """Predict silhouettes of twisted beams from hanging fits; write OUT/twisted.csv, OUT/twisted.md, OUT/twisted/IMAGE.png.

    The second clamp has no marker. It is rotated by `TURN` and not moved (`given`), or both values are fitted to the image
    (`fitted`). Stiffness is that of OUT/fits.csv and OUT/springs. `swapped` is a control with exchanged halves.
    """
    beam, fits = Beam(cad), pd.read_csv(out / "fits.csv")
    mean, lines = fits.groupby(["beam", "row"])[["left", "right"]].mean(), list[dict[str, Any]]()
    for view in views_of(beam, folder, pattern, (1, -1)):
        made = {"t_e_c": "h_e_c", "t_m_c": "h_m_c"}.get(view.name.partition("__")[0], "h_em_c")
        for row, fit, every in known_of(beam, mean, out / "springs", made):
            held = Twisted(beam)
            stiffness = every[held.kept]
            nodes = held.twist(TURN, 0.0, stiffness)
            given = TURN, 0.0, nodes, *posed(view, nodes, np.zeros(6))
            for clamp, (turn, shift, nodes, q, loss) in {
                "given": given,
                "fitted": second_clamp(view, held, stiffness, given),
            }.items():
                surface = beam.carried @ nodes
                keys = {"picture": view.name, "row": row, "fit": fit, "clamp": clamp, "turn": turn, "shift": shift, "loss": loss}
                lines.append(keys | view.scores(surface, q))
                print(lines[-1], flush=True)
                drawn(view, surface, q, out / "twisted" / f"{view.name}_{row}_{fit}_{clamp}.png")
    table = pd.DataFrame(lines)
    table.to_csv(out / "twisted.csv", index=False, float_format="%.5g")
    means = table.groupby(["row", "clamp"], sort=False)["outline"].mean().unstack("clamp")
    rows = [[ROWS.get(str(row), str(row)), *(f"{outline:.1f}" for outline in own)] for row, *own in means.itertuples()]
    head = ["twin", *(f"outline [px], second clamp {clamp}" for clamp in means)]
    write_text(
        out / "twisted.md", "\n".join(["# Twisted, mean over images and fits", "", *Table.of_texts(head, rows).markdown(), ""])
    )


def known_of(beam: Beam, mean: pd.DataFrame, springs: Path, made: str) -> Iterator[tuple[str, str, np.ndarray]]:
    """Method, fit and stiffness [S], N, from fits of the hanging beam `made`: means of halves, then each fit of springs."""
    part = np.clip(beam.middles[:, 0] * CELLS / (2 * THICK) + 0.5, 0, 1)
    for row in ("regions", "uniform", "swapped") if made == "h_em_c" else ("uniform",):
        left, right = mean.loc[(made, "regions" if row == "swapped" else row)][:: -1 if row == "swapped" else 1]
        yield row, "mean", left ** (1 - part) * right**part
    for path in sorted(springs.glob(f"{made}_*.npy")):
        _, number, row, start = path.stem.rsplit("_", 3)
        yield row, f"{number}-{start}", np.load(path).astype(float)


Clamped = tuple[float, float, np.ndarray, np.ndarray, float]
"""Rotation [degrees] and shift [mm] of the second clamp, nodes [N, 3], m, pose [6], loss."""


SIZES = (1.0, 0.4, 0.2)
"""Successive step sizes for the second clamp, in units of 4 mm and 10 degrees."""


def second_clamp(view: View, held: Twisted, stiffness: np.ndarray, best: Clamped) -> Clamped:
    """Pose of the second clamp with the lowest loss, by a coordinate search with shrinking steps."""
    for size in SIZES:
        for axis, step in ((1, 4.0), (0, 10.0), (1, 4.0), (0, 10.0)):
            tried = [best]
            for move in (-2, -1, 1, 2):
                turn, shift = np.array(best[:2]) + size * step * move * np.eye(2)[axis]
                nodes = held.twist(turn, shift, stiffness)
                tried.append((float(turn), float(shift), nodes, *posed(view, nodes, best[3])))
            best = min(tried, key=lambda each: each[-1])
    return best


def drawn(view: View, surface: np.ndarray, q: np.ndarray, path: Path) -> None:
    """Draw the predicted silhouette (gray) and the observed outline on compared pixels, without the image."""
    picture = np.full((*view.mask.shape, 3), 255, np.uint8)
    picture[view.drawn(surface, q)] = 200
    picture[view.counted == 0] = picture[view.counted == 0] // 2 + 90
    outline, _ = cv2.findContours(view.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outline, -1, (40, 40, 220), 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture)


ROWS = {
    "uniform": "one stiffness",
    "predicted": "predicted: stiffness of the beams of one material, only the pose fitted",
    "regions": "two regions, boundary known",
    "regions_sought": "two regions, boundary fitted (PT)",
    "springs": "free springs",
    "field": "field (tri-plane)",
    "shuffled": "`shuffled` field",
    "rod_uniform": "rod, one modulus",
    "rod": "rod, five knots",
}


def step_in(part: pd.DataFrame) -> float:
    """Correlation of log stiffness along the beam with a step at the middle, the truth."""
    logs = np.log(part["stiffness"])
    return float(np.corrcoef(logs, part["x"] < 0)[0, 1]) if logs.std() > 1e-6 else np.nan


def tables(out: Path, cad: Path) -> None:
    """Write OUT/summary.md and OUT/stiffness.png from OUT/fits.csv and OUT/along.csv."""
    fits, along = pd.read_csv(out / "fits.csv"), pd.read_csv(out / "along.csv", dtype={"start": str})
    unit = young_per_newton(Beam(cad)) / 1e3
    fits = fits[fits["row"].isin([*ROWS, "given_ratio"])]

    def span(values: pd.Series, digits: int) -> str:
        values = values.dropna()
        low, high = (f"{v:.{digits}f}" for v in (values.min(), values.max())) if len(values) else ("–", "–")
        return f"{values.mean():.{digits}f} ({low} to {high})" if low != high else low

    alone, rows = fits[fits["beam"] != "h_em_c"], []
    for (name, row), part in alone.groupby(["beam", "row"], sort=False):
        moduli = part["left"] * unit if row == "uniform" else part["left"] / 1e3
        springs = span(part["left"], 2) if row == "uniform" else "–"
        rows.append([BEAMS[str(name)][0], ROWS[str(row)], springs, span(moduli, 0), span(part["outline"], 2), span(part["iou"], 3)])
    lines = ["# Two silicones", "", "## Beams of one material: mean over three images (least to largest)", ""]
    lines += Table.of_texts(["beam", "twin", "stiffness of a spring [N]", "E [kPa]", "outline [px]", "IoU"], rows).markdown()
    for row, part in alone.groupby("row", sort=False):
        means = part.groupby("beam")["left"].mean()
        lines += ["", f"Ratio of MoldStar to Ecoflex, {ROWS[str(row)]}: {means['h_m_c'] / means['h_e_c']:.2f}"]
    slices = along[(along["beam"] == "h_em_c") & (along["x"].abs() < HEAD) & (along["x"] != 0)].groupby(["row", "picture", "start"])
    related = {keys: step_in(part) for keys, part in slices}
    both = fits[fits["beam"] == "h_em_c"].assign(start=lambda table: table["start"].astype(str))
    both["along"] = [related.get(keys, np.nan) for keys in zip(both["row"], both["picture"], both["start"], strict=True)]
    rows, columns = [], {"ratio": 2, "correlation": 2, "along": 2, "loss": 2, "outline": 2, "iou": 3}
    for row, heading in ROWS.items():
        part = both[both["row"] == row]
        if len(part):
            cells = [span(part[name], digits) for name, digits in columns.items()]
            rows.append([heading, str(len(part)), *cells])
    lines += ["", f"## Both: x < 0 over x > 0 (known: {TRUTH}), mean over fits (least to largest)", ""]
    lines += Table.of_texts(
        ["twin", "fits", "ratio", "r, springs", "r, slices of 1 cm", "loss [px²]", "outline [px]", "IoU"], rows
    ).markdown()
    given = both[both["row"] == "given_ratio"].sort_values("ratio")
    lines += ["", "## Loss over the ratio, other variables fitted, one image", ""]
    lines += Table.of_texts(
        ["ratio", *(f"{r:g}" for r in given["ratio"])], [["loss [px²]", *(f"{v:.2f}" for v in given["loss"])]]
    ).markdown()
    write_text(out / "summary.md", "\n".join([*lines, ""]))
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained", width_ratios=(2, 1))
    for number, row in enumerate(
        name for name in ("regions", "regions_sought", "springs", "field", "shuffled", "rod") if name in set(both["row"])
    ):
        for _, part in along[(along["beam"] == "h_em_c") & (along["row"] == row)].groupby(["picture", "start"]):
            part = part[part["x"].abs() <= HEAD]
            relative = part["stiffness"] / part.loc[part["x"] > 0, "stiffness"].mean()
            left.plot(part["x"], relative, color=f"C{number}", lw=0.9, label=ROWS[row])
    left.plot([-HEAD, 0, 0, HEAD], [TRUTH, TRUTH, 1, 1], "k--", lw=1.2, label="known")
    handles = dict(zip(*left.get_legend_handles_labels()[::-1], strict=True))
    left.legend(handles.values(), handles, fontsize=7)
    left.set(xlabel="x [cm], the clamp at 7", ylabel="stiffness over its mean at x > 0", yscale="log")
    right.plot(given["ratio"], given["loss"], "o-", ms=3)
    right.set(xlabel="ratio", ylabel="loss [px²]", xscale="log")
    figure.savefig(out / "stiffness.png", dpi=110)


def main() -> None:
    """Run one of the three commands."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("hanging", "tables", "twisted"))
    parser.add_argument("folder", type=Path, help="folder with views.json and images, there or in images/")
    parser.add_argument("out", type=Path)
    parser.add_argument("--cad", type=Path, help="folder of the CAD files (default: FOLDER/cad)")
    parser.add_argument("--rows", nargs="*", default=[], help="hanging: only these methods")
    parser.add_argument("--pictures", default="t_*_c__*.png", help="twisted: file pattern of images")
    options = parser.parse_args()
    cad = (options.cad or options.folder / "cad") / "cantilever_f1494_v749.obj"
    options.out.mkdir(parents=True, exist_ok=True)
    if options.command == "hanging":
        hanging(options.folder, options.out, cad, options.rows)
    elif options.command == "twisted":
        twisted(options.folder, options.out, cad, options.pictures)
    else:
        tables(options.out, cad)


if __name__ == "__main__":
    main()
