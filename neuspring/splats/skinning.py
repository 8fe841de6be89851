"""Linear blend skinning: the nodes of a twin carry the splats from frame to frame.

Every node b has a rotation R_b between two frames. It best maps the offsets to the 16 nodes that are nearest in frame 0 (Kabsch).
A splat at x follows its 16 nearest nodes, by positions p_b before the step, with weights w_b ~ 1 / (|x - p_b| + 1e-6 m):

    x' = sum_b w_b [R_b (x - p_b) + p'_b],    q' = normalize(sum_b w_b q(R_b)) q.

Motion accumulates from frame to frame, as in PhysTwin's released evaluation. A hash grid finds the nearest nodes, so time and
memory do not grow with the product of nodes and splats.
"""

import itertools
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import torch
import warp as wp
from scipy.spatial import cKDTree

from neuspring.core.device import load, start_warp
from neuspring.core.errors import InputError

SKIN_NEIGHBORS = 16
MOST_CELLS = 64
"""Maximum number of cells of the hash grid along one axis."""
SMALLEST_RADIUS = 1e-4
"""Minimum radius of a search for nodes, m."""
DEGENERATE = 1e-5
"""A neighborhood is a line if its second singular value is below this fraction of the first: thinner than 0.3 % of its length."""
POINT_SPREAD = 1e-30
"""A neighborhood below this value is a point, m^2."""
DISTANCE_OFFSET = 1e-6
"""Offset that weights add to distances, m."""
DOUBLINGS = 60


class Skin:
    """Move splats with nodes whose positions in frame 0 are `nodes` [N, 3], m.

    frozen: each splat keeps the nodes of its first step, and only the weights change; fast enough for real time.
    """

    def __init__(self, nodes: np.ndarray, *, device: str = "cpu", frozen: bool = False) -> None:
        start_warp()
        if len(nodes) == 0 or not np.isfinite(nodes).all():
            raise InputError("skinning, nodes", "one or more nodes are required, all finite", np.shape(nodes))
        self._device, self._frozen = device, frozen
        self._bound: Any = None
        self._count = min(SKIN_NEIGHBORS, len(nodes))
        # The search doubles this radius where it contains too few nodes. A larger start would make every search slower.
        usual = np.median(cKDTree(nodes).query(nodes, k=[self._count])[0])
        self._radius = float(max(1.2 * usual, SMALLEST_RADIUS))
        # Searches far from all nodes visit every cell, so the grid should not have many more cells than nodes.
        cells = np.clip(np.ceil(np.ptp(nodes, axis=0) / self._radius).astype(int) + 1, 1, MOST_CELLS)
        wide, deep, high = cells.tolist()
        self._grid = wp.HashGrid(wide, deep, high, device=device)
        with _on_torch_stream(device):
            start = self._vectors(nodes)
            self._relations = self._nearest(start, start, own=True, wanted=min(SKIN_NEIGHBORS, len(nodes) - 1))

    def step(
        self, before: np.ndarray, after: np.ndarray, means: torch.Tensor, quaternions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Means [S, 3] m and quaternions [S, 4] (w first) after the nodes moved from `before` to `after` [N, 3], m."""
        moved, turned = torch.empty_like(means), torch.empty_like(quaternions)
        with _on_torch_stream(self._device):
            old, new = self._vectors(before), self._vectors(after)
            rotations = self._rotations(old, new)
            start = wp.from_torch(means.detach().float().contiguous(), dtype=wp.vec3)
            if self._bound is None or not self._frozen:
                self._bound = self._nearest(old, start, own=False, wanted=self._count)
            orientation = wp.from_torch(quaternions.detach().float().contiguous(), dtype=wp.vec4)
            outputs = [wp.from_torch(moved, dtype=wp.vec3), wp.from_torch(turned, dtype=wp.vec4)]
            self._launch(move_splats, len(means), [old, new, rotations, self._bound, start, orientation, *outputs])
        return moved, turned

    def carry(
        self, positions: np.ndarray, means: torch.Tensor, quaternions: torch.Tensor
    ) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yield (means, quaternions) in every frame of a trajectory [F, N, 3], m; the given ones are those of frame 0."""
        yield means, quaternions
        for before, after in itertools.pairwise(positions):
            means, quaternions = self.step(before, after, means, quaternions)
            yield means, quaternions

    def _rotations(self, before: Any, after: Any) -> Any:
        count = len(before)
        rotations = wp.zeros(count, dtype=wp.mat33, device=self._device)
        self._launch(turn_nodes, count, [before, after, self._relations, rotations])
        return rotations

    def _nearest(self, points: Any, queries: Any, *, own: bool, wanted: int) -> Any:
        neighbors = wp.zeros((len(queries), wanted), dtype=int, device=self._device)
        if wanted:
            distances = wp.zeros((len(queries), wanted), dtype=float, device=self._device)
            self._grid.build(points, self._radius)
            arguments = [self._grid.id, points, queries, own, wanted, self._radius, neighbors, distances]
            self._launch(nearest, len(queries), arguments)
        return neighbors

    def _vectors(self, values: np.ndarray) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device=self._device)

    def _launch(self, kernel: Any, size: int, arguments: list[Any]) -> None:
        wp.launch(load(kernel, self._device), size, arguments, device=self._device)


def _on_torch_stream(device: str) -> AbstractContextManager[Any]:
    """Run Warp on Torch's current stream, on which Torch orders its own work."""
    if device == "cpu":
        return nullcontext()
    stream = wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)))
    return stream


@wp.kernel(enable_backward=False)
def nearest(
    grid: wp.uint64,
    points: wp.array[wp.vec3],
    queries: wp.array[wp.vec3],
    own: wp.bool,
    wanted: int,
    radius: float,
    neighbors: wp.array2d[int],
    distances: wp.array2d[float],
):
    """The `wanted` nearest points of each query, nearest first. With `own`, query i is point i and excludes itself.

    The search radius doubles until it contains enough points.
    """
    t = wp.tid()
    place = queries[t]
    reach = radius
    for _attempt in range(DOUBLINGS):
        count = wp.int32(0)
        seen = wp.hash_grid_query(grid, place, reach)
        for j in seen:
            if not (own and j == t):
                d = wp.length(points[j] - place)
                if d <= reach and (count < wanted or d < distances[t, wanted - 1]):
                    slot = wp.min(count, wanted - 1)
                    while slot > 0 and distances[t, slot - 1] > d:
                        distances[t, slot] = distances[t, slot - 1]
                        neighbors[t, slot] = neighbors[t, slot - 1]
                        slot -= 1
                    distances[t, slot] = d
                    neighbors[t, slot] = j
                    count = wp.min(count + 1, wanted)
        if count >= wanted:
            break
        reach = reach * 2.0


@wp.func
def shortest_turn(start: wp.vec3d, end: wp.vec3d):
    """The rotation with the smallest angle that maps the unit vector `start` to `end`."""
    axis = wp.cross(start, end)
    cosine = wp.dot(start, end)
    identity = wp.identity(n=3, dtype=wp.float64)
    turn = identity
    if cosine > wp.float64(-0.999999999):
        cross = wp.skew(axis)
        turn = identity + cross + cross * cross * (wp.float64(1.0) / (wp.float64(1.0) + cosine))
    else:
        # A half turn about any perpendicular axis.
        other = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
        if wp.abs(start[0]) > wp.float64(0.9):
            other = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
        around = wp.normalize(wp.cross(start, other))
        turn = wp.outer(around, around) * wp.float64(2.0) - identity
    return turn


@wp.kernel(enable_backward=False)
def turn_nodes(
    before: wp.array[wp.vec3],
    after: wp.array[wp.vec3],
    neighbors: wp.array2d[int],
    rotations: wp.array[wp.mat33],
):
    """The rotation that best maps each node's offsets to its neighbors from `before` to `after`."""
    i = wp.tid()
    moment = wp.mat33d()
    for k in range(neighbors.shape[1]):
        j = neighbors[i, k]
        moment += wp.outer(wp.vec3d(after[j] - after[i]), wp.vec3d(before[j] - before[i]))
    u, s, v = wp.svd3(moment)
    turn = wp.identity(n=3, dtype=wp.float64)
    if s[0] > wp.float64(POINT_SPREAD):
        if s[1] > wp.float64(DEGENERATE) * s[0]:
            turn = u * wp.transpose(v)
        else:
            turn = shortest_turn(wp.normalize(wp.transpose(v)[0]), wp.normalize(wp.transpose(u)[0]))
    rotations[i] = wp.mat33(turn)


@wp.kernel(enable_backward=False)
def move_splats(
    before: wp.array[wp.vec3],
    after: wp.array[wp.vec3],
    rotations: wp.array[wp.mat33],
    bound: wp.array2d[int],
    means: wp.array[wp.vec3],
    quaternions: wp.array[wp.vec4],
    moved: wp.array[wp.vec3],
    turned: wp.array[wp.vec4],
):
    """Linear blend skinning of one splat by the nodes `bound` to it."""
    t = wp.tid()
    place = means[t]
    total = wp.float32(0.0)
    # Averages displacements, not positions: far from the origin they keep their precision.
    shift = wp.vec3(0.0)
    blend = wp.quat(0.0, 0.0, 0.0, 0.0)
    for k in range(bound.shape[1]):
        i = bound[t, k]
        arm = place - before[i]
        weight = 1.0 / (wp.length(arm) + DISTANCE_OFFSET)
        total += weight
        shift += weight * (after[i] - before[i] + (rotations[i] * arm - arm))
        q = wp.quat_from_matrix(rotations[i])
        if q[3] < 0.0:
            q = -q
        blend += q * weight
    moved[t] = place + shift / total
    q = wp.normalize(blend)
    own = quaternions[t]
    r = q * wp.quat(own[1], own[2], own[3], own[0])
    turned[t] = wp.vec4(r[3], r[0], r[1], r[2])
