"""A beam of the two-material study: its lattice, its equilibrium, and images with camera poses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.optimize import minimize
from scipy.sparse import bsr_array, csr_array, kron

from neuspring import config
from neuspring.core.artifacts import Simulation, Twin
from neuspring.core.errors import NumericalFailure
from neuspring.physics.parameters import homogeneous
from neuspring.physics.reference import ReferenceTwin, incidence, spring_forces
from neuspring.physics.topology import build, object_springs
from neuspring.scores.pictures import iou
from neuspring.twin.losses import FrameLoss, ImageEvidence

CM = 0.01
TO_MARKER = np.array([-9.15, -3.5, -1.75])
"""Origin of the beam's CAD frame in the marker's frame, cm."""
UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from the CAD frame, y up, to the simulator's world, z up."""
INTRINSICS = np.array([[902.5, 0.0, 653.2], [0.0, 903.7, 363.3], [0.0, 0.0, 1.0]])
SIDE = 0.020
"""Side of the marker, m."""
DENSITY, GRAVITY = 1080.0, 9.81
HALF, HEAD, THICK = 10.0, 7.0, 1.5
"""Half length of the beam, of its part between the heads, and half thickness, cm; heads are twice as high."""
CELLS = 4
"""Cells of the lattice across the thickness."""
REACH = 1.55
"""Largest spring length in spacings: sides and face diagonals. E / G along the axes is 2.96, of silicone 3."""
CORNER, INDEPENDENT = 0.3, 50
"""Standard deviation of a marker corner, px; number of independent points of a silhouette."""
BAND = 15.0
"""Compared width of a silhouette from its outline, px; pixels further inside add no information."""
HIDDEN = 6.0
"""Distance to a clamp within which nothing is compared, cm: a clamp mirrors and hides the beam."""
COLLAPSED = 0.65
"""Length over rest length below which a lattice is folded; the next equilibrium then starts from the rest shape."""


class Beam:
    """The lattice of a beam in the CAD frame, cm: nodes, springs, masses, and the surface that it carries."""

    def __init__(self, cad: Path) -> None:
        step = 2 * THICK / CELLS
        side, middle = np.linspace(HEAD, HALF, CELLS + 1)[1:], np.linspace(-HEAD, HEAD, 2 * round(HEAD / step) + 1)
        height = np.linspace(-2 * THICK, 2 * THICK, 2 * CELLS + 1)
        self.axes = np.concatenate([-side[::-1], middle, side]), height, np.linspace(-THICK, THICK, CELLS + 1)
        there = _within(self.axes, 1e-6)
        number = np.where(there, np.cumsum(there).reshape(there.shape) - 1, -1)
        self.nodes = _grid(self.axes)[there]
        every = np.full(len(self.nodes), REACH * step)
        self.springs = object_springs(self.nodes, every, np.full(len(self.nodes), 99))
        self.middles = self.nodes[self.springs].mean(axis=1)
        centers = tuple((a[1:] + a[:-1]) / 2 for a in self.axes)
        solid = _within(centers, 0.0)
        volumes = np.prod(_grid(tuple(np.diff(a) for a in self.axes)), axis=-1)[solid]
        self.mass = DENSITY * CM**3 * (self._weights(number, _grid(centers)[solid]).T @ volumes)
        words = [line.split() for line in cad.read_text().splitlines()]
        vertices = np.array([[float(c) for c in w[1:4]] for w in words if w[:1] == ["v"]])
        faces = np.array([[int(c.split("/")[0]) - 1 for c in w[1:4]] for w in words if w[:1] == ["f"]])
        self.surface, self.faces = _finer(*_finer(vertices, faces))
        self.carried = self._weights(number, self.surface)
        x, y = self.nodes[:, 0], np.abs(self.nodes[:, 1])
        # A clamp holds the walls of a head; the material at its window can deform a little.
        walls = (y > 2 * THICK - 0.1) | (np.abs(x) > HALF - 0.1) | ((np.abs(x) < HEAD + 0.1) & (y > THICK + 0.1))
        self.clamps = [walls & (x > HEAD - 0.1), walls & (x < 0.1 - HEAD)]

    def _weights(self, number: np.ndarray, points: np.ndarray) -> csr_array:
        """Trilinear weights [P, N] of the nodes at points [P, 3]."""
        low = [np.clip(np.searchsorted(a, points[:, k], "right") - 1, 0, len(a) - 2) for k, a in enumerate(self.axes)]
        part = [(points[:, k] - a[low[k]]) / np.diff(a)[low[k]] for k, a in enumerate(self.axes)]
        found = []
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod([p if c else 1 - p for p, c in zip(part, corner, strict=True)], axis=0)
            node = number[tuple(row + c for row, c in zip(low, corner, strict=True))]
            rows = np.flatnonzero(weight > 1e-9)
            found.append((weight[rows], rows, node[rows]))
        values, rows, columns = (np.concatenate(each) for each in zip(*found, strict=True))
        return csr_array((values, (rows, columns)), shape=(len(points), len(self.nodes)))


def _grid(axes: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _within(axes: Sequence[np.ndarray], margin: float) -> np.ndarray:
    x, y, _ = np.moveaxis(_grid(axes), -1, 0)
    return np.asarray((np.abs(x) > HEAD - margin) | (np.abs(y) < THICK + margin))


def _finer(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide each triangle into four."""
    edges, inverse = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2), axis=0, return_inverse=True)
    a, b, c, (ab, bc, ca) = *faces.T, len(vertices) + inverse.reshape(-1, 3).T
    parts = [np.stack(corners, axis=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate([vertices, vertices[edges].mean(axis=1)]), np.concatenate(parts)


def world(points: np.ndarray) -> np.ndarray:
    """Points from the CAD frame, cm, in the marker's frame with z up, m."""
    return np.asarray(CM * (points + TO_MARKER) @ UP.T)


class Held:
    """A beam held at some nodes: a twin, and its equilibrium under gravity."""

    folded = COLLAPSED

    def __init__(self, beam: Beam, held: np.ndarray) -> None:
        """`held` [N]: nodes that are controllers of the twin."""
        self.beam, self.held, self.free = beam, np.flatnonzero(held), np.flatnonzero(~held)
        order = np.argsort(np.concatenate([self.free, self.held]))
        self.kept = np.flatnonzero(~held[beam.springs].all(axis=1))
        self.kept = self.kept[np.argsort(held[beam.springs[self.kept]].any(axis=1), kind="stable")]
        nodes = world(beam.nodes)
        topology = build(nodes[self.free], nodes[self.held], order[beam.springs[self.kept]])
        numbers = {"stiffness": 3.0, "dashpot": 0.0, "drag": 12.0, "contact_distance": 1e-3}
        contact = dict.fromkeys(("ground_elasticity", "ground_friction", "contact_elasticity", "contact_friction"), 0.0)
        material = replace(homogeneous(numbers | contact, len(self.kept)), mass=beam.mass[self.free])
        self.twin = Twin(
            topology=topology,
            material=material,
            simulation=Simulation(frame_time=0.05, substeps=400, gravity=GRAVITY, ground=False),
        )
        self._scene = ReferenceTwin.of(self.twin)
        self._mass = beam.mass[self.free, None]
        self._spread = csr_array(incidence(self._scene))
        self._wide = csr_array(kron(self._spread, np.eye(3)))
        self.rest, self.hands = nodes[self.free], nodes[self.held]
        self.x = self.rest

    def _springs(self) -> tuple[np.ndarray, np.ndarray]:
        """Length over rest length [S], and direction [S, 3]."""
        points = np.concatenate([self.x, self.hands])[self._scene.springs]
        offset = points[:, 1] - points[:, 0]
        length = np.linalg.norm(offset, axis=1)
        return length / self._scene.rest_lengths, offset / length[:, None]

    def _force(self, stiffness: np.ndarray) -> np.ndarray:
        points = np.concatenate([self.x, self.hands])
        force = spring_forces(replace(self._scene, stiffness=stiffness), points, np.zeros_like(points))
        return np.asarray(self._spread @ force - GRAVITY * self._mass * [0.0, 0.0, 1.0])

    def _solved(self, stiffness: np.ndarray, right: np.ndarray, *, exact: bool) -> np.ndarray:
        """K^-1 b for b [N, 3]. Without `exact`, K omits the stress of compressed springs, which can make K indefinite."""
        ratio, d = self._springs()
        along, outer = stiffness / self._scene.rest_lengths, d[:, :, None] * d[:, None, :]
        across = along * (1 - 1 / ratio if exact else np.maximum(1 - 1 / ratio, 0.0))
        blocks = along[:, None, None] * outer + across[:, None, None] * (np.eye(3) - outer)
        count = len(blocks)
        k = self._wide @ bsr_array((blocks, np.arange(count), np.arange(count + 1))).tocsr() @ self._wide.T
        entries = k.tocoo()
        row, column = entries.coords
        below = row >= column
        band = np.zeros((int((row - column).max()) + 1, k.shape[0]))
        band[(row - column)[below], column[below]] = entries.data[below]
        factor = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
        return np.asarray(cho_solve_banded((factor, True), right.ravel(), check_finite=False).reshape(-1, 3))

    def _energy(self, stiffness: np.ndarray) -> float:
        stored = stiffness * self._scene.rest_lengths * (self._springs()[0] - 1) ** 2 / 2
        return float(stored.sum() + GRAVITY * (self._mass[:, 0] * self.x[:, 2]).sum())

    def settle(self, stiffness: np.ndarray) -> np.ndarray:
        """All nodes of the beam [N, 3], m, in equilibrium (Newton, line search). Raises NumericalFailure without convergence."""
        if self._springs()[0].min() < self.folded:
            self.x = self.rest
        weight = GRAVITY * float(self._mass.sum())
        for _ in range(300):
            force = self._force(stiffness)
            largest = np.abs(force).max() / weight
            if largest < 1e-8:
                break
            try:
                step = self._solved(stiffness, force, exact=largest < 1e-3)
            except LinAlgError:
                step = self._solved(stiffness, force, exact=False)
            step *= min(1.0, 0.02 / np.abs(step).max())
            start, before, part = self.x, self._energy(stiffness), 1.0
            self.x = start + step
            while self._energy(stiffness) > before - 1e-4 * part * (step * force).sum() + 1e-12 * abs(before) and part > 1e-3:
                part /= 2
                self.x = start + part * step
        else:
            raise NumericalFailure(f"no equilibrium: a force of {largest:.1e} of the weight remains")
        return self.placed(self.x)

    def placed(self, x: np.ndarray) -> np.ndarray:
        """All nodes of the beam [N, 3], m, including held nodes."""
        nodes = np.empty((len(self.free) + len(self.held), 3))
        nodes[self.free], nodes[self.held] = x, self.hands
        return nodes

    def pulled_back(self, stiffness: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Derivative by stiffness [S] from that by all nodes [N, 3]; in equilibrium K dx = df/dY dY."""
        adjoint = self._solved(stiffness, gradient[self.free], exact=True)
        ratio, d = self._springs()
        return np.asarray(((self._spread.T @ adjoint) * d).sum(axis=1) * (ratio - 1))


class Equilibrium(torch.autograd.Function):
    """All nodes of a `Held` in equilibrium [N, 3], m, from its stiffness [S]."""

    @staticmethod
    def forward(ctx: Any, stiffness: torch.Tensor, held: Held) -> torch.Tensor:  # type: ignore[override]
        ctx.held, ctx.stiffness = held, stiffness
        return torch.from_numpy(held.settle(stiffness.detach().double().numpy()))

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:  # type: ignore[override]
        found = ctx.held.pulled_back(ctx.stiffness.detach().double().numpy(), gradient.numpy())
        return torch.from_numpy(found).to(ctx.stiffness.dtype), None


def silhouette_of(picture: np.ndarray) -> np.ndarray:
    """Largest component of saturated red or blue [H, W]; the dark line between the colors is filled."""
    hue, saturation, value = (channel.astype(int) for channel in cv2.split(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)))
    colored = ((hue >= 165) | (hue <= 5) | ((hue >= 88) & (hue <= 112))) & (saturation > 120) & (value > 40)
    closed = cv2.morphologyEx(colored.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    _, pieces, found, _ = cv2.connectedComponentsWithStats(closed)
    return np.asarray(pieces == 1 + found[1:, cv2.CC_STAT_AREA].argmax())


class View:
    """An image: its silhouette, the pose of its camera from the marker's corners, and the compared pixels."""

    def __init__(self, beam: Beam, picture: Path, pose: Any, ends: tuple[int, ...] = (1,)) -> None:
        """`pose` [4, 4]: marker in the camera, to find its corners; `ends`: signs of x of the clamps."""
        image = cv2.imread(str(picture))
        self.beam, self.name, self.mask = beam, picture.stem, silhouette_of(image)
        flat = SIDE / 2 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
        turn, place = np.array(pose)[:3, :3], np.array(pose)[:3, 3]
        near = np.ascontiguousarray(_projected(flat @ turn.T + place)[:, None], np.float32)
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self.corners = cv2.cornerSubPix(gray, near, (3, 3), (-1, -1), (3, 50, 1e-3))[:, 0].astype(float)
        _, turns, places, _ = cv2.solvePnPGeneric(flat, self.corners, INTRINSICS, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
        self.turn, self.place, self.square = cv2.Rodrigues(turns[0])[0] @ UP.T, places[0][:, 0], flat @ UP.T
        self.counted, shown = np.ones(self.mask.shape, np.uint8), np.ones(len(beam.surface), bool)
        for sign in ends:
            shown &= sign * beam.surface[:, 0] < HIDDEN
            box = np.array([[sign * x, y, z] for x in (HIDDEN, HALF + 1) for y in (-3, 3) for z in (-2.5, 2.5)])
            hull = cv2.convexHull(_projected(world(box) @ self.turn.T + self.place).astype(np.float32))
            cv2.fillConvexPoly(self.counted, hull.astype(np.int32), 0)
        away = cv2.distanceTransform((~self.mask).astype(np.uint8), cv2.DIST_L2, 5) * self.counted
        within = cv2.distanceTransform(self.mask.astype(np.uint8), cv2.DIST_L2, 5)
        y, x = np.nonzero((within > 0) & (within < BAND) & (self.counted > 0))
        chosen = np.random.default_rng(0).choice(len(x), 600, replace=False)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = torch.tensor(self.turn), torch.tensor(self.place)
        self.shown = np.flatnonzero(shown)
        none, size = torch.zeros(1, 0, 3), float(self.place[2] / INTRINSICS[0, 0])
        inside, outside = torch.tensor(np.stack([x, y], axis=1)[chosen][None]).double(), torch.tensor(away[None]).double()
        evidence = ImageEvidence(pose, torch.tensor(INTRINSICS), none[..., :2], none[..., 0], inside, outside, 1, size)
        weights = config.Losses(chamfer=0.0, track=0.0, image_track=0.0)
        self._loss = FrameLoss(none, none, none, int(shown.sum()), weights, image=evidence)
        carried = beam.carried[shown].tocoo()
        self._carried = torch.sparse_coo_tensor(np.stack(carried.coords), carried.data, carried.shape, check_invariants=True)

    def seen(self, points: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Points [P, 3] of the world in a camera that q [6], degrees and mm, rotates and moves from the marker's pose."""
        a, b, c = torch.deg2rad(q[:3])
        zero = torch.zeros_like(a)
        skew = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero]).reshape(3, 3)
        return points @ (torch.linalg.matrix_exp(skew) @ torch.tensor(self.turn)).T + torch.tensor(self.place) + 1e-3 * q[3:]

    def loss(self, points: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Loss in squared pixels of the shown surface points [P, 3] (silhouette) and of the marker's corners."""
        back = (self.seen(points, q) - torch.tensor(self.place)) @ torch.tensor(self.turn)
        marker = self.seen(torch.tensor(self.square), q) @ torch.tensor(INTRINSICS).T
        corners = (marker[:, :2] / marker[:, 2:] - torch.tensor(self.corners)) / CORNER
        assert self._loss.image is not None
        return self._loss(0, back) / self._loss.image.size**2 + corners.square().sum() / INDEPENDENT

    def of_nodes(self, nodes: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """`loss` for the nodes of a lattice [N, 3]."""
        return self.loss(self._carried @ nodes, q)

    def drawn(self, surface: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Predicted silhouette [H, W] of all surface points [P, 3]."""
        pixels = _projected(self.seen(torch.from_numpy(surface), torch.from_numpy(q)).numpy())
        result = np.zeros(self.mask.shape, np.uint8)
        for triangle in np.round(16 * pixels[self.beam.faces]).astype(np.int32):
            cv2.fillConvexPoly(result, triangle, 1, shift=4)
        return result > 0

    def scores(self, surface: np.ndarray, q: np.ndarray) -> dict[str, float]:
        """IoU, and mean distance of the two outlines in px, on compared pixels."""
        counted = self.counted > 0
        masks = [self.mask & counted, self.drawn(surface, q) & counted]
        edges = [cv2.morphologyEx(m.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) for m in masks]
        inner = cv2.erode(self.counted, np.ones((9, 9), np.uint8)) > 0
        apart = [cv2.distanceTransform(1 - b, cv2.DIST_L2, 5)[(a > 0) & inner].mean() for a, b in (edges, edges[::-1])]
        return {"iou": iou(*masks), "outline": float(np.mean(apart))}


def _projected(local: np.ndarray) -> np.ndarray:
    flat = local @ INTRINSICS.T
    return np.asarray(flat[:, :2] / flat[:, 2:])


def views_of(beam: Beam, folder: Path, pattern: str, ends: tuple[int, ...] = (1,)) -> list[View]:
    """Images of a folder or of its folder images with a pose in views.json. Exits with an error without such images."""
    known = {
        name: pose for each in json.loads((folder / "views.json").read_text()).values() for name, pose in each["images"].items()
    }
    pictures = sorted(path for path in [*folder.glob(pattern), *folder.glob(f"images/{pattern}")] if path.name in known)
    if not pictures:
        raise SystemExit(f"{folder}: must contain an image {pattern} with a pose in views.json")
    return [View(beam, path, known[path.name], ends) for path in pictures]


def posed(view: View, nodes: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, float]:
    """Pose [6] of the camera for nodes [N, 3], and the loss."""
    points = view._carried @ torch.from_numpy(nodes)

    def value(p: np.ndarray) -> tuple[float, np.ndarray]:
        free = torch.tensor(p, requires_grad=True)
        loss = view.loss(points, free)
        loss.backward()
        return loss.item(), free.grad.numpy()

    best = minimize(value, q, jac=True, method="L-BFGS-B", options={"maxiter": 60, "ftol": 1e-5})
    return best.x, float(best.fun)
