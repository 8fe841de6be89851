"""The arrays of one solver, in the layout of the kernels, and sequences of launches captured as graphs.

B twins are in G groups of W lanes (lanes.py). A quantity of points is an array [points, G] of Vectors, a quantity of springs an
array [S, G] of Numbers, and a quantity of a twin an array [G] of Numbers. Torch tensors share their storage. On a CPU, W lanes
share the instructions of one thread. On a GPU W = 1, and a thread computes a point of one twin. The twins of a group share one
table of springs. Unused lanes repeat the last twin of their table.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import copy
import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from neuspring.core.artifacts import Simulation
from neuspring.core.device import load, start_warp
from neuspring.physics.lanes import lanes, width_for
from neuspring.physics.parameters import PARAMETERS, Parameters

UNFUSED = {"module": "unique", "enable_backward": False, "module_options": {"fuse_fp": False}}
"""Options of the kernels of a frame. Fused products and sums round only once. GPUs and CPUs fuse differently, which would flip
contacts on one of them."""

BEHIND = 8
"""Elements behind the end of an array that blocks read but do not use (blocks.py)."""


@functools.cache
def structs(real: Any, width: int) -> tuple[Any, Any, Any]:
    """Structs (Model, State, Adjoint), the arguments of every kernel, for a scalar type and a number of lanes."""
    lane = lanes(real, width)
    of_twin: Any = wp.array(dtype=lane.Number)
    numbers: Any = wp.array2d(dtype=lane.Number)
    vectors: Any = wp.array2d(dtype=lane.Vector)
    slots: Any = wp.array3d(dtype=lane.Vector)
    counts: Any = wp.array3d(dtype=lane.Number)
    integers: Any = wp.array(dtype=int)
    lists: Any = wp.array3d(dtype=int)
    table: Any = wp.array2d(dtype=int)

    class Model:
        nodes: int
        controllers: int
        first: int
        substeps: int
        fewest: int
        slots: int
        history: int
        collide: int
        capacity: int
        up: real
        gravity: lane.Vector
        first_row: integers
        first_spring: integers
        rows: integers
        partners: integers
        links: integers
        link_partners: integers
        link_springs: integers
        counts: of_twin
        substep: of_twin
        inverse_time: of_twin
        near: lists
        near_lanes: lists
        near_count: table
        pair_rows: table
        pair_other: table
        pair_lanes: table
        closing: table
        bits: numbers
        alike: int

    @wp.struct
    class State:
        begin: vectors
        end: vectors
        x: slots
        v: slots
        after: slots
        moving: slots
        met: counts
        force: vectors

    class Adjoint:
        x: vectors
        v: vectors
        moving: vectors
        after: vectors
        force: slots

    kinds = {"spring": vectors, "node": numbers, "twin": of_twin}
    Model.__annotations__ |= {name: kinds[parameter.per] for name, parameter in PARAMETERS.items()}
    # The gradient of a twin's number is stored per node and summed later.
    kinds["twin"] = numbers
    Adjoint.__annotations__ |= {name: kinds[parameter.per] for name, parameter in PARAMETERS.items() if parameter.trained}
    return wp.struct(Model), State, wp.struct(Adjoint)


class Buffers:
    """Torch tensors by name, each with a Warp view of the same storage.

    - x, v [slots, N + C]: state of nodes, then controllers
    - after [history, N]: velocities after the forces
    - moving [history, N]: velocities after the impulses
    - begin, end [C]: path of the controllers

    Every term adds its own arrays. A differentiable solver stores all substeps of the last frame, slot k before substep k.
    Otherwise one slot is sufficient for a single thread, and two slots alternate if each node has a thread.
    """

    def __init__(
        self,
        nodes: int,
        controllers: int,
        simulations: Sequence[Simulation],
        device: str,
        dtype: torch.dtype,
        *,
        differentiable: bool,
        threads: bool,
        tables: Sequence[int] = (),
        sizes: Sequence[int] = (),
    ) -> None:
        """`tables`: index of the spring table of each twin (default: 0). `sizes`: number of nodes of each twin (default: all)."""
        start_warp()
        self.nodes, self.controllers, self.simulation = nodes, controllers, simulations[0]
        self.device, self.dtype, self.differentiable, self.threads = device, dtype, differentiable, threads
        self.real = wp.float32 if dtype == torch.float32 else wp.float64
        self.twins = len(simulations)
        self.sizes = list(sizes) or [nodes] * self.twins
        members = [
            [k for k, table in enumerate(tables or [0] * self.twins) if table == one] for one in range(max(tables, default=0) + 1)
        ]
        self.width = 1 if threads else width_for(max(map(len, members)))
        self.table_of_group: list[int] = []
        seats = []
        for table, twins in enumerate(members):
            groups = -(-len(twins) // self.width)
            self.table_of_group += [table] * groups
            seats += twins + twins[-1:] * (groups * self.width - len(twins))
        self.groups = len(self.table_of_group)
        self._seat(seats, [seats.index(twin) for twin in range(self.twins)])
        self.lanes = lanes(self.real, self.width)
        self.counts = [simulation.substeps for simulation in simulations]
        self.first, self.substeps = 0, max(self.counts)
        self.tensors: dict[str, torch.Tensor] = {}
        self.views: dict[str, Any] = {}
        self.indices: dict[str, torch.Tensor] = {}
        self.alike = False
        """True if all nodes of a twin have the same mass; impulses are then divided in halves."""
        self.history = self.substeps if differentiable else 1
        self.slots = self.substeps + 1 if differentiable else 2 if threads else 1
        total = nodes + controllers
        self.add_vectors(x=(self.slots, total), v=(self.slots, total), after=(self.history, nodes))
        self.add_vectors(begin=(controllers,), end=(controllers,))
        self.add_vectors(adj_x=(total,), adj_v=(total,), adj_after=(nodes,))
        self.add_vectors(adj_force=(2, total), **({} if threads else {"force": (total,)}))
        self.add_numbers(counts=None, substep=None, inverse_time=None)
        self.set_numbers("counts", torch.tensor(self.counts, dtype=dtype, device=device))
        self.set_numbers("substep", torch.tensor([s.substep for s in simulations], dtype=dtype, device=device))
        inverse_times = [1.0 / s.frame_time if s.controller_velocity else 0.0 for s in simulations]
        self.set_numbers("inverse_time", torch.tensor(inverse_times, dtype=dtype, device=device))
        # Without self-collision, velocities do not change between the forces and the motion.
        self.views |= {"moving": self.views["after"]} | ({"adj_moving": self.views["adj_after"]} if differentiable else {})

    def add_vectors(self, **shapes: tuple[int, ...]) -> None:
        """Add arrays of Vectors, initially zero. Only a differentiable solver has adjoints (adj_...)."""
        for name, shape in shapes.items():
            if self.differentiable or not name.startswith("adj_"):
                tensor = self._zeros(shape, (3, self.width))
                self.tensors[name], self.views[name] = tensor, wp.from_torch(tensor, dtype=self.lanes.Vector)

    def add_numbers(self, **sizes: int | tuple[int, int] | None) -> None:
        """Add arrays of Numbers: [size, G], or [G] for a number per twin (None). Adjoints (adj_...) as for Vectors."""
        for name, size in sizes.items():
            if self.differentiable or not name.startswith("adj_"):
                shape = () if size is None else (size,) if isinstance(size, int) else size
                tensor = self._zeros(shape, (self.width,))
                self.tensors[name], self.views[name] = tensor, wp.from_torch(tensor, dtype=self.lanes.Number)

    def _seat(self, seats: Sequence[int], own: Sequence[int]) -> None:
        """Store the twin of each lane of each group, and the lane of each twin."""
        self._in_order = own == list(range(self.twins))
        self.seats, self._own = (torch.tensor(places, device=self.device) for places in (seats, own))

    def of_twins(self, values: torch.Tensor) -> torch.Tensor:
        """Reorder [G W, ...] in the order of lanes to [B, ...]."""
        return values[: self.twins] if self._in_order else values.index_select(0, self._own)

    def part(self, twins: slice) -> "Buffers":
        """The state of some twins, in the same storage; arrays added to it are separate.

        The twins must have the same nodes. Their groups may contain lanes of other twins.
        """
        first, stop, _ = twins.indices(self.twins)
        own, seats, count = copy.copy(self), self._own[first:stop].tolist(), stop - first
        begin, end = min(seats) // self.width, max(seats) // self.width + 1
        own.twins, own.groups, own.nodes = count, end - begin, self.sizes[first]
        places = self.seats[begin * self.width : end * self.width].tolist()
        others = [twin - first if first <= twin < first + count else 0 for twin in places]
        own._seat(others, [seat - begin * self.width for seat in seats])
        own.tensors = {name: self.tensors[name][:, :, begin:end] for name in ("x", "v")}
        own.views = {name: wp.from_torch(tensor, dtype=self.lanes.Vector) for name, tensor in own.tensors.items()}
        return own

    def _zeros(self, shape: tuple[int, ...], entry: tuple[int, ...]) -> torch.Tensor:
        """Zeros [*shape, G, *entry]. Contiguous in memory: with threads all twins of a point, otherwise all data of a group."""
        kind = {"dtype": self.dtype, "device": self.device}
        if self.threads:
            return torch.zeros((*shape, self.groups, *entry), **kind)
        size = math.prod((self.groups, *shape, *entry))
        return torch.zeros(size + 3 * BEHIND, **kind)[:size].view(self.groups, *shape, *entry).movedim(0, len(shape))

    def add_integers(self, **values: np.ndarray) -> None:
        """Add constant arrays of integers."""
        for name, array in values.items():
            self.indices[name] = torch.tensor(np.ascontiguousarray(array, np.int32), device=self.device)
            self.views[name] = wp.from_torch(self.indices[name], dtype=wp.int32)

    def set_table(self, name: str, shape: tuple[int, ...]) -> None:
        """Create an array of integers, initially zero; it replaces an earlier array of this name."""
        self.indices[name] = torch.zeros(shape, dtype=torch.int32, device=self.device)
        self.views[name] = wp.from_torch(self.indices[name], dtype=wp.int32)
        self.__dict__.pop("arguments", None)

    def set_span(self, first: int, substeps: int) -> None:
        """Simulate only the substeps from `first` to `substeps` of a frame."""
        self.first, self.substeps = first, substeps
        self.__dict__.pop("arguments", None)

    def set_vectors(self, name: str, values: torch.Tensor, slot: int | None = None) -> None:
        """Copy values [B, P, 3] to the first P points of an array; `slot` selects a slot."""
        target = self.tensors[name] if slot is None else self.tensors[name][slot]
        padded = self._padded(values.detach())
        lanes_last = padded.reshape(self.groups, self.width, values.shape[1], 3).permute(2, 0, 3, 1)
        target[: values.shape[1]].copy_(lanes_last)

    def get_vectors(self, name: str, slot: int | None = None, count: int | None = None) -> torch.Tensor:
        """Return the first `count` Vectors of an array (None: all) as [B, P, 3]; `slot` selects a slot."""
        source = (self.tensors[name] if slot is None else self.tensors[name][slot])[:count]
        twins = source.permute(1, 3, 0, 2).reshape(self.groups * self.width, len(source), 3)
        return self.of_twins(twins).clone()

    def set_numbers(self, name: str, values: torch.Tensor) -> None:
        """Copy numbers of twins [B], or of their springs [B, S], to an array."""
        padded = self._padded(values.detach())
        rest = padded.shape[1:]
        grouped = padded.reshape(self.groups, self.width, *rest)
        self.tensors[name].copy_(grouped.permute(2, 0, 1) if rest else grouped)

    def get_numbers(self, name: str) -> torch.Tensor:
        """Return Numbers [size, G] as [B, size]."""
        source = self.tensors[name]
        twins = source.permute(1, 2, 0).reshape(self.groups * self.width, len(source))
        # Contiguous, so that the order of a sum over a twin's numbers does not depend on the width.
        return self.of_twins(twins).contiguous()

    def add_parameters(self, springs: int) -> None:
        """Add the parameters declared in parameters.py, and their adjoints."""
        for name, parameter in PARAMETERS.items():
            adjoint = {f"adj_{name}"} if parameter.trained else set()
            if parameter.per == "spring":
                self.add_vectors(**dict.fromkeys({name} | adjoint, (springs,)))
            else:
                size = self.nodes if parameter.per == "node" else None
                self.add_numbers(**{name: size}, **dict.fromkeys(adjoint, self.nodes))

    def set_parameter(self, name: str, values: torch.Tensor) -> None:
        """Copy a parameter with a leading axis [B]; springs are in the caller's order."""
        per = PARAMETERS[name].per
        if per == "spring":
            self.set_vectors(name, values.index_select(1, self.indices["order"]))
        else:
            self.set_numbers(name, values.expand(-1, self.nodes) if per == "node" else values)

    def gradients(self) -> Parameters:
        """Return dL/d(parameters) [B, ...] of the trained parameters."""
        result = {}
        for name, parameter in PARAMETERS.items():
            if parameter.trained and parameter.per == "spring":
                own = self.get_vectors(f"adj_{name}")
                # The kernels omit the factor Y of dL/d(1 / l0).
                own[..., 1] *= self.get_vectors(name)[..., 0]
                result[name] = own.index_select(1, self.indices["ranks"])
            elif parameter.trained:
                of_nodes = self.get_numbers(f"adj_{name}")
                result[name] = of_nodes if parameter.per == "node" else self._sums(of_nodes)
        return result

    def _sums(self, of_nodes: torch.Tensor) -> torch.Tensor:
        """Sum over the nodes of each twin, without padding nodes, which would change the order of the sum."""
        if set(self.sizes) == {self.nodes}:
            return of_nodes.sum(dim=1)
        return torch.cat([of_nodes[k : k + 1, :size].sum(dim=1) for k, size in enumerate(self.sizes)])

    def _padded(self, values: torch.Tensor) -> torch.Tensor:
        alone = self._in_order and len(self.seats) == self.twins
        return values if alone else values.index_select(0, self.seats)

    @functools.cached_property
    def arguments(self) -> tuple[Any, Any, Any]:
        """(Model, State, Adjoint) of these arrays. They are created at first use, when every term has added its arrays."""
        sim, kinds = self.simulation, structs(self.real, self.width)
        plain = {
            "nodes": self.nodes,
            "controllers": self.controllers,
            "first": self.first,
            "substeps": self.substeps,
            "fewest": min(self.counts),
            "slots": self.slots,
            "history": self.history,
            "collide": int(sim.self_collision),
            "capacity": sim.collision_capacity,
            "alike": int(self.alike),
            "up": sim.up_sign if sim.ground else 0.0,
            "gravity": self.lanes.Vector(*[0.0] * (2 * self.width), *[-sim.gravity * sim.up_sign] * self.width),
        }
        made = []
        for kind, prefix in zip(kinds, ("", "", "adj_"), strict=True):
            struct = kind()
            for name in kind.vars:
                if prefix + name in self.views:
                    setattr(struct, name, self.views[prefix + name])
                elif name in plain and not prefix:
                    setattr(struct, name, plain[name])
            made.append(struct)
        return tuple(made)

    def launch(self, kernel: Any, size: int | tuple[int, int], *arguments: Any) -> None:
        """Run a kernel on `size` threads."""
        wp.launch(kernel, size, [*arguments], device=self.device)


class Graphs:
    """Captured sequences of launches by name. The first run records a sequence, later runs replay it."""

    def __init__(self, device: str) -> None:
        self.device = device
        self._graphs: dict[str, Any] = {}

    def run(self, name: str, kernels: Iterable[Any], record: Callable[[], None]) -> None:
        """Replay the launches of `record`. All `kernels` are loaded first, because a capture must not load any."""
        if name not in self._graphs:
            for kernel in kernels:
                load(kernel, self.device)
            with wp.ScopedCapture(device=self.device) as capture:
                record()
            self._graphs[name] = capture.graph
        # Torch orders its own work on its current stream, so the graph must run there too.
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device)) if self.device != "cpu" else None
        wp.capture_launch(self._graphs[name], stream=stream)
