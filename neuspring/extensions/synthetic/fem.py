"""Finite elements with hands, which create the motion of synthetic captures with Newton's solvers.

The numerics differ from the spring-mass simulator of the twins: stable neo-Hookean tetrahedra, membranes with hinge bending, and
penalty contacts. `FiniteElements` is explicit (semi-implicit Euler); the largest eigenvalue of its forces determines the substeps.
`VertexBlockDescent` is the held-out engine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import warp as wp

from neuspring.core.device import start_warp
from neuspring.core.errors import NumericalFailure
from neuspring.core.extras import needed
from neuspring.extensions.synthetic import kernels
from neuspring.extensions.synthetic.bodies import SoftBody
from neuspring.extensions.synthetic.meshes import edges, volumes
from neuspring.extensions.synthetic.scenes import FIST_RADIUS, Hand
from neuspring.scenes.rays import on_cpu

if TYPE_CHECKING:
    import newton
else:
    # Warp modules copy the settings at import: without adjoints the engine's kernels compile in half the time.
    start_warp()
    newton = needed("newton")

GRAVITY = 9.81
"""m/s^2, towards -z."""
CONTACT_GRID = (32, 32, 32)
"""Cells of the neighbor search. Clearing the engine's default of 128 cells per axis would take most of each substep."""
LEAST_MASS = 0.3
"""Smallest mass of a solid's node, as a fraction of the median; lighter nodes would determine the time step."""
MAX_SPEED = 20.0
"""m/s; the engine clips faster nodes."""
Moduli = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def lame(youngs_modulus: np.ndarray, poisson_ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lame parameters mu and lambda, Pa."""
    mu = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    return mu, youngs_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))


def stable_moduli(youngs_modulus: np.ndarray, poisson_ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Constants 4/3 mu and lambda + 5/6 mu, Pa, of the engine's stable neo-Hookean energy for these small-strain moduli.

    Source: Smith et al. 2018.
    """
    mu, first = lame(youngs_modulus, poisson_ratio)
    return 4.0 / 3.0 * mu, first + 5.0 / 6.0 * mu


def build(body: SoftBody, fists: int, moduli: Moduli = stable_moduli, dashpots: bool = True, colored: bool = False) -> newton.Model:
    """Build the engine's model of a body, a table and kinematic fists.

    `dashpots` adds a spring without stiffness to every edge of a solid; the caller sets its damping. `colored` groups nodes so that
    no two nodes of a group are connected, for solvers that move one node after the other.
    """
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
    shape = builder.default_shape_cfg.copy()
    shape.mu, shape.ke, shape.kd, shape.kf = body.friction, body.contact_stiffness, body.contact_damping, 0.0
    builder.add_ground_plane(cfg=shape)
    if body.is_sheet:
        _add_sheet(builder, body)
    else:
        _add_solid(builder, body, moduli, dashpots)
    for _ in range(fists):
        builder.add_shape_sphere(builder.add_body(is_kinematic=True, mass=1.0), radius=FIST_RADIUS, cfg=shape)
    if colored:
        builder.color(include_bending=body.is_sheet)
    model = builder.finalize(device="cpu")
    if body.self_contact:
        model.particle_ke, model.particle_kd = body.self_contact_stiffness, 0.01
        model.particle_kf, model.particle_mu = 0.0, 0.3
        model.particle_grid = wp.HashGrid(*CONTACT_GRID, device="cpu")
    else:
        model.particle_grid = None
    model.soft_contact_ke, model.soft_contact_kd = body.contact_stiffness, body.contact_damping
    model.soft_contact_kf, model.soft_contact_mu = 0.0, 0.0
    model.particle_max_velocity = MAX_SPEED
    return model


def _add_solid(builder: newton.ModelBuilder, body: SoftBody, moduli: Moduli, dashpots: bool) -> None:
    for node in body.nodes:
        builder.add_particle(wp.vec3(*node), wp.vec3(), 0.0, body.radius)
    mass = np.zeros(len(body.nodes))
    elastic = zip(*moduli(body.youngs_modulus, body.poisson_ratio), strict=True)
    for corners, (mu, first), density in zip(body.tetrahedra.tolist(), elastic, body.density, strict=True):
        a, b, c, d = corners
        volume = builder.add_tetrahedron(a, b, c, d, float(mu), float(first), 0.0)
        mass[corners] += density * volume / 4.0
    builder.particle_mass[:] = np.maximum(mass, LEAST_MASS * np.median(mass)).tolist()
    for corners, stiffness in zip(body.triangles.tolist(), body.membrane, strict=True):
        ke = float(stiffness)
        builder.add_triangle(*corners, tri_ke=ke, tri_ka=ke / 2.0, tri_kd=0.0, tri_drag=body.air_drag, tri_lift=0.0)
    for i, j in edges(body.tetrahedra).tolist() if dashpots else ():
        builder.add_spring(i, j, 0.0, 0.0, 0.0)


def _add_sheet(builder: newton.ModelBuilder, body: SoftBody) -> None:
    builder.add_cloth_mesh(
        pos=(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),  # type: ignore[arg-type]
        scale=1.0,
        vel=(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*node) for node in body.nodes],
        indices=body.triangles.ravel().tolist(),
        density=body.sheet_density,
        tri_ke=1.0,
        tri_ka=1.0,
        tri_kd=0.0,
        edge_ke=1.0,
        edge_kd=0.0,
        particle_radius=body.radius,
        tri_drag=body.air_drag,
    )
    materials = np.array(builder.tri_materials)
    materials[:, 0], materials[:, 1] = body.membrane, body.membrane / 2.0
    builder.tri_materials[:] = [tuple(row) for row in materials.tolist()]
    hinges = np.array(builder.edge_bending_properties)
    hinges[:, 0] = body.bending[np.array(builder.edge_indices)[:, 2:]].mean(axis=1)
    builder.edge_bending_properties[:] = [tuple(row) for row in hinges.tolist()]


SAFETY = 0.6
"""Time step as a fraction of the critical step."""
COLLIDE_EVERY = 5
"""Substeps between contact searches; the contact margin covers the motion between them."""
DAMP_EVERY = 4
"""Substeps between dampings of the deformation, which is a slow process."""
PERIOD = math.lcm(COLLIDE_EVERY, DAMP_EVERY, 2)
"""Substeps after which the sequence of contacts, dampings and swapped states repeats."""
CONTACT_MARGIN = 0.02
"""m."""
POWER_ITERATIONS = 60
NUDGE = 1e-6
"""m. Standard deviation per coordinate, about the rounding of single precision over a few substeps."""
ESCAPED = 5.0
"""m. A clip with a node farther from the origin has diverged."""


@dataclass(frozen=True, kw_only=True)
class Damping:
    """Numerical damping, in addition to that of the material."""

    deformation: float = 2.0
    """1/s. Damping of motion relative to the best rigid motion."""
    drag: float = 0.1
    """1/s. Damping of all motion."""
    edges: float = 0.35
    """Dashpots on the edges of tetrahedra, as a fraction of the largest stable ones; they damp oscillations of single elements."""


@dataclass(frozen=True)
class Clip:
    """A simulated motion."""

    positions: np.ndarray
    """Nodes [T, N, 3], m; frame 0 is the start."""
    kinetic: np.ndarray
    """[T], J."""
    potential: np.ndarray
    """[T], J."""
    least_jacobian: np.ndarray
    """[T] smallest det F of a tetrahedron; 1 for sheets."""
    substeps: int


class FiniteElements:
    """Simulates a body with its hands from `start` (None: the rest shape), on one core.

    `substeps` is even; its default follows from the critical step. `holder` [N] is the hand that holds each node (-1: none); by
    default a hand holds the nodes within its reach.
    """

    def __init__(
        self,
        body: SoftBody,
        hands: Sequence[Hand],
        frames: int,
        frame_rate: float,
        damping: Damping,
        start: np.ndarray | None = None,
        substeps: int | None = None,
        holder: np.ndarray | None = None,
    ) -> None:
        self.body, self.hands, self.frames, self.frame_rate, self.damping = body, tuple(hands), frames, frame_rate, damping
        self.start = body.nodes if start is None else start
        fists = [index for index, hand in enumerate(hands) if hand.kind == "fist"]
        # The engine declares all arrays of models and states as optional; these exist.
        self.model: Any = self._build(len(fists))
        self.volumes = volumes(body.nodes, body.tetrahedra)
        self.mass: np.ndarray = self.model.particle_mass.numpy().astype(float)  # type: ignore[union-attr]
        self.solver = self._solver()
        self.pipeline = newton.CollisionPipeline(self.model, soft_contact_gap=CONTACT_MARGIN)
        self.contacts = self.pipeline.contacts()
        self.control = self.model.control()
        self.now: Any = self.model.state()
        self.next: Any = self.model.state()
        self._maxwell = self._maxwell_state()
        self.substeps = self._choose_substeps(substeps)
        self._hold(fists, holder)
        self._graphs: dict[int, wp.Graph] = {}

    @property
    def substep(self) -> float:
        """Length of a substep, s."""
        return 1.0 / (self.frame_rate * self.substeps)

    def again(self, frames: int, start: np.ndarray, substeps: int) -> Self:
        """A new engine with the same body and hands; the hands hold the same nodes even if `start` differs."""
        return type(self)(self.body, self.hands, frames, self.frame_rate, self.damping, start, substeps, self.holder)

    def run(self) -> Clip:
        """Simulate all frames. Raises NumericalFailure if nodes escape or become infinite."""
        rows = [self._measure(self.start)]
        for frame in range(1, self.frames):
            self._frame()
            position = self.now.particle_q.numpy()
            if not np.isfinite(position).all() or np.abs(position).max() > ESCAPED:
                raise NumericalFailure(f"the finite-element clip diverged in frame {frame} with {self.substeps} substeps per frame")
            rows.append(self._measure(position))
        positions, kinetic, potential, jacobian = (np.array(column) for column in zip(*rows, strict=True))
        return Clip(positions, kinetic, potential, jacobian, self.substeps)

    def _build(self, fists: int) -> newton.Model:
        return build(self.body, fists)

    def _solver(self) -> newton.solvers.SolverBase:
        return newton.solvers.SolverSemiImplicit(self.model, enable_tri_contact=False)

    def _choose_substeps(self, substeps: int | None) -> int:
        step, dashpot = self._critical_step()
        self._set_dashpots(dashpot)
        return substeps or max(2 * int(np.ceil(1.0 / (self.frame_rate * step) / 2)), 2)

    def _maxwell_state(self) -> list[wp.array] | None:
        """Tetrahedra, inverse rest shapes, volumes, moduli, strain and stress of the Maxwell branch; None without one."""
        body = self.body
        share = body.viscosity[0]
        if body.is_sheet or not share:
            return None
        corners = (positions[body.tetrahedra] for positions in (body.nodes, self.start))
        # Edge matrices [E, 3, 3]: columns point from corner 0 to corners 1, 2 and 3.
        rest, deformed = (np.swapaxes(each[:, 1:] - each[:, :1], 1, 2) for each in corners)
        inverse = np.linalg.inv(rest)
        gradient = deformed @ inverse
        strain = 0.5 * (np.swapaxes(gradient, 1, 2) @ gradient - np.eye(3))
        mu, first = lame(share * body.youngs_modulus, body.poisson_ratio)
        return [
            on_cpu(body.tetrahedra, wp.int32),
            on_cpu(inverse, wp.mat33),
            *(on_cpu(values, wp.float32) for values in (self.volumes, mu, first)),
            on_cpu(strain, wp.mat33),
            wp.zeros(len(body.tetrahedra), dtype=wp.mat33, device="cpu"),
        ]

    def _hold(self, fists: list[int], earlier: np.ndarray | None) -> None:
        """Place the hands, and assign the nodes that they hold: those in reach in frame 0, or those of `earlier`."""
        hands = self.hands
        times = np.arange((self.frames - 1) * self.substeps + 2) * self.substep
        poses = np.stack([hand.poses(times) for hand in hands]) if hands else np.zeros((1, len(times), 7))
        holder, local = np.full(len(self.start), -1, dtype=np.int32), np.zeros((len(self.start), 3))
        for index, hand in enumerate(hands):
            # Rotations of keys are relative to frame 0, in which a hand's frame has the world's axes.
            assert not np.any(hand.keys[0][2]), "a hand must start without rotation"
            offset = self.start - poses[index, 0, :3]
            if hand.kind == "grip":
                within = np.linalg.norm(offset, axis=1) < hand.reach
                gripped = (within & (holder < 0)) if earlier is None else earlier == index
                assert gripped.any(), "a hand must hold something"
                holder[gripped], local[gripped] = index, offset[gripped]
        self.holder = holder
        inverse = np.where((self.mass > 0) & (holder < 0), 1.0 / np.maximum(self.mass, 1e-12), 0.0)
        self.model.particle_inv_mass.assign(inverse.astype(np.float32))
        for state in (self.now, self.next):
            state.particle_q.assign(self.start.astype(np.float32))
        self._poses = on_cpu(poses, wp.transform)
        self._holder = on_cpu(holder, wp.int32)
        self._local = on_cpu(local, wp.vec3)
        self._fists = on_cpu(np.array(fists, dtype=np.int32), wp.int32)
        self._step = wp.zeros(1, dtype=wp.int32, device="cpu")
        self._sums = wp.zeros(19, dtype=wp.float32, device="cpu")

    def _frame(self) -> None:
        """Simulate one frame in repeating blocks of substeps: the first block of a length compiles, the second is recorded as a
        graph, and later blocks replay the graph."""
        periods, rest = divmod(self.substeps, PERIOD)
        for count in [PERIOD] * periods + [rest] * (rest > 0):
            if count not in self._graphs:
                self._substeps(count)
                with wp.ScopedCapture(device="cpu") as capture:
                    self._substeps(count)
                self._graphs[count] = capture.graph
            else:
                wp.capture_launch(self._graphs[count])

    def _substeps(self, count: int) -> None:
        """Simulate the first `count` substeps of a PERIOD."""
        dt, contacts = self.substep, self.contacts
        for k in range(count):
            now, following = self.now, self.next
            now.clear_forces()
            self._drive(now)
            if len(self._fists):
                pushed = [self._step, self._poses, self._fists, dt, now.body_q, now.body_qd]
                wp.launch(kernels.drive_bodies, len(self._fists), pushed, device="cpu")
            self._add_maxwell(now, float(np.exp(-dt / self.body.viscosity[1])))
            if k % COLLIDE_EVERY == 0:
                self.pipeline.collide(now, contacts)
            self.solver.step(now, following, self.control, contacts, dt)
            self._rub(now, following, dt)
            if k % DAMP_EVERY == 0:
                self._damp(following, DAMP_EVERY * dt)
            wp.launch(kernels.advance, 1, [self._step], device="cpu")
            self.now, self.next = following, now

    def _drive(self, state: newton.State) -> None:
        """Move held nodes with their hands."""
        held = [self._step, self._poses, self._holder, self._local, self.substep, state.particle_q, state.particle_qd]
        wp.launch(kernels.drive_nodes, self.model.particle_count, held, device="cpu")

    def _add_maxwell(self, state: newton.State, decay: float, fresh: bool = False) -> None:
        """Add the forces of the Maxwell branch; with `fresh`, start from zero strain and stress and keep the stored ones."""
        if self._maxwell is None:
            return
        *fixed, strain, stress = self._maxwell
        if fresh:
            strain, stress = wp.zeros_like(strain), wp.zeros_like(stress)
        arguments = [*fixed, decay, state.particle_q, strain, stress, state.particle_f]
        wp.launch(kernels.maxwell, len(self.body.tetrahedra), arguments, device="cpu")

    def _rub(self, before: newton.State, after: newton.State, dt: float) -> None:
        contacts, model = self.contacts, self.model
        arguments = [
            *(contacts.soft_contact_count, contacts.soft_contact_particle, contacts.soft_contact_shape),
            *(contacts.soft_contact_body_pos, contacts.soft_contact_normal, model.shape_body),
            *(self.body.friction, self.body.contact_stiffness, before.body_q, before.body_qd),
            *(model.particle_radius, model.particle_inv_mass, before.particle_q, dt, after.particle_q, after.particle_qd),
        ]
        wp.launch(kernels.coulomb, contacts.soft_contact_max, arguments, device="cpu")

    def _damp(self, state: newton.State, dt: float) -> None:
        self._sums.zero_()
        count, model = self.model.particle_count, self.model
        wp.launch(kernels.moments, count, [state.particle_q, state.particle_qd, model.particle_mass, self._sums], device="cpu")
        rates = [self.damping.deformation, self.damping.drag, dt]
        arguments = [state.particle_q, model.particle_inv_mass, self._sums, *rates, state.particle_qd]
        wp.launch(kernels.damp_deformation, count, arguments, device="cpu")

    def _measure(self, positions: np.ndarray) -> tuple[np.ndarray, float, float, float]:
        """Positions, kinetic and potential energy, smallest Jacobian."""
        body, x = self.body, np.asarray(positions, dtype=float)
        speed = self.now.particle_qd.numpy().astype(float)
        kinetic = 0.5 * float((self.mass[:, None] * speed**2).sum())
        potential = GRAVITY * float((self.mass * x[:, 2]).sum())
        jacobian = 1.0
        if not body.is_sheet:
            jacobian = float((volumes(x, body.tetrahedra) / self.volumes).min())
        return positions.copy(), kinetic, potential, jacobian

    def _critical_step(self) -> tuple[float, float]:
        """SAFETY times the largest stable step, s, and the matching dashpot of every edge, N s/m.

        Symplectic Euler is stable for dt < (-c + sqrt(c^2 + 4 w^2)) / w^2. Here w^2 is the largest eigenvalue of M^-1 K, and c that
        of M^-1 C; both follow from power iteration on the engine's forces.
        """
        frequency = np.sqrt(self._largest("position"))
        if self.body.is_sheet or not self.damping.edges:
            return SAFETY * _stable(frequency, self._largest("velocity")), 0.0
        unit = 1e-3
        self._set_dashpots(unit)
        per_dashpot = self._largest("velocity") / unit
        step = SAFETY * _stable(frequency, 0.0)
        for _ in range(20):
            dashpot = self.damping.edges / step / per_dashpot
            step = min(step, SAFETY * _stable(frequency, per_dashpot * dashpot))
        return step, dashpot

    def _set_dashpots(self, value: float) -> None:
        if self.model.spring_count:
            self.model.spring_damping.fill_(value)

    def _largest(self, of: str) -> float:
        """Largest eigenvalue of M^-1 K (`of` position) or M^-1 C (velocity) at rest."""
        rest = self.body.nodes
        still = np.zeros_like(rest)
        base = self._acceleration(rest, still)
        direction = np.random.default_rng(0).normal(size=rest.shape)
        value = 0.0
        for _ in range(POWER_ITERATIONS):
            step = (1e-5 if of == "position" else 1e-2) * direction / np.abs(direction).max()
            moved = self._acceleration(rest + step, still) if of == "position" else self._acceleration(rest, step)
            response = base - moved
            value = float(np.linalg.norm(response) / np.linalg.norm(step))
            if value == 0.0:
                return 0.0
            direction = response / np.linalg.norm(response)
        return value

    def _acceleration(self, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """Acceleration [N, 3], m/s^2: the change of velocity in one engine step of one second without contacts."""
        state, after = self.now, self.next
        state.particle_q.assign(positions.astype(np.float32))
        state.particle_qd.assign(velocities.astype(np.float32))
        state.clear_forces()
        # An instantaneous change of strain loads the branch like a spring with its modulus.
        self._add_maxwell(state, 1.0, fresh=True)
        limit, grid = self.model.particle_max_velocity, self.model.particle_grid
        self.model.particle_max_velocity, self.model.particle_grid = np.inf, None
        self.solver.step(state, after, self.control, None, 1.0)
        self.model.particle_max_velocity, self.model.particle_grid = limit, grid
        change = after.particle_qd.numpy().astype(float) - velocities
        for used in (state, after):
            used.particle_qd.zero_()
        return np.asarray(change)


def settle(body: SoftBody, frame_rate: float, seconds: float = 4.0, still: float = 0.01) -> np.ndarray:
    """Node positions [N, 3], m, of the body at rest on the table.

    The body is dropped with strong drag until no node is faster than `still`, m/s, for at most `seconds`.
    """
    position, frames = body.nodes, max(int(0.5 * frame_rate), 2)
    for _ in range(int(np.ceil(2 * seconds))):
        engine = FiniteElements(body, (), frames, frame_rate, Damping(deformation=8.0, drag=4.0), start=position)
        position = engine.run().positions[-1]
        if np.abs(engine.now.particle_qd.numpy()).max() < still:
            break
    return position


def certify(engine: FiniteElements, clip: Clip, frames: int) -> tuple[float, float]:
    """Mean distance of nodes from `clip`, m, in the worst of the first `frames` frames.

    The first value is for twice the substeps, the second for a start that is NUDGE off. A wrinkling cloth amplifies any difference,
    so compare the first value with the second, not with zero.
    """
    frames = min(frames, len(clip.positions))
    nudged = engine.start + NUDGE * np.random.default_rng(0).normal(size=engine.start.shape)
    trials = (engine.again(frames, engine.start, 2 * clip.substeps), engine.again(frames, nudged, clip.substeps))
    moved = [np.linalg.norm(e.run().positions - clip.positions[:frames], axis=2).mean(axis=1).max() for e in trials]
    return float(moved[0]), float(moved[1])


def _stable(frequency: float, damping: float) -> float:
    return float((-damping + np.sqrt(damping**2 + 4.0 * frequency**2)) / frequency**2)


VBD_SUBSTEPS, VBD_ITERATIONS = 40, 10
"""Converged values for these scenes; the smaller values of games are far from convergence."""


class VertexBlockDescent(FiniteElements):
    """Vertex block descent (Chen et al. 2024): implicit Euler, solved node by node, for solids that hands grasp.

    Fists and sheets are not supported. The material has the plain Lame parameters. Damping comes only from implicit Euler, and
    friction is the engine's smoothed Coulomb friction.
    """

    def _build(self, fists: int) -> newton.Model:
        assert not fists, "the held-out engine has no fists"
        assert not self.body.is_sheet, "the held-out engine has no sheets"
        model = build(self.body, 0, lame, dashpots=False, colored=True)
        model.soft_contact_mu = self.body.friction
        return model

    def _solver(self) -> newton.solvers.SolverBase:
        return newton.solvers.SolverVBD(self.model, iterations=VBD_ITERATIONS, particle_enable_tile_solve=False)

    def _choose_substeps(self, substeps: int | None) -> int:
        return substeps or VBD_SUBSTEPS

    def _hold(self, fists: list[int], earlier: np.ndarray | None) -> None:
        super()._hold(fists, earlier)
        # Inactive, because even a node without inverse mass would yield to its neighbors.
        flags = np.where(self.holder < 0, int(newton.ParticleFlags.ACTIVE), 0)
        self.model.particle_flags.assign(flags.astype(np.int32))

    def _substeps(self, count: int) -> None:
        for _ in range(count):
            now, following = self.now, self.next
            now.clear_forces()
            # Held nodes do not move within a step, so they get their position at its end.
            wp.launch(kernels.advance, 1, [self._step], device="cpu")
            self._drive(now)
            self.pipeline.collide(now, self.contacts)
            self.solver.step(now, following, self.control, self.contacts, self.substep)
            self.now, self.next = following, now
