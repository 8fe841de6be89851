"""Checks 2, 3 and 6: springs rebuilt from the searched parameters, scores of the released prediction, replay of the checkpoint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from neuspring.config import Fit
from neuspring.core.artifacts import Material, Observations, Simulation, Topology, Trajectory, Twin
from neuspring.core.errors import InputError
from neuspring.core.progress import Progress
from neuspring.data import phystwin
from neuspring.data.cases import released_cases
from neuspring.data.released import Checkpoint, Released, read_checkpoint, read_parameters, read_prediction
from neuspring.scores import metrics
from neuspring.scores.released.findings import Finding, Published, of_scores, require
from neuspring.twin.rollout import simulate
from neuspring.twin.search import RELEASED_FRAME_TIME, RELEASED_SUBSTEPS
from neuspring.twin.topology import uniform_topology

DISTANCES = ("chamfer", "track_error")
POSITION = 2e-5
"""m, mean over nodes: within this, recorded clips of the released simulator are followed."""
SPREAD = 10.0
"""A replay may differ from the released one by so many times what the order of additions alone changes: on a GPU that order is not
defined, and contacts between nodes flip with rounding. On the recorded clips the largest ratio was 2.4."""


def topology(case: Released, seen: Observations) -> list[Finding]:
    """Check 2: as many springs, and between object nodes, as the checkpoint has, and as are known of the case."""
    require(case.root, case.parameters, case.checkpoint)
    parameters, checkpoint = read_parameters(case.parameters), read_checkpoint(case.checkpoint)
    rebuilt = _springs(seen, parameters)
    counts = [
        ("springs", len(rebuilt.springs), len(checkpoint.stiffness), "the checkpoint"),
        ("object springs", rebuilt.object_spring_count, checkpoint.object_springs, "the checkpoint"),
    ]
    known = released_cases().get(case.name)
    if known is not None:
        counts.append(("springs", len(rebuilt.springs), int(known["springs"]), "the table of released cases"))
    return [
        Finding(check=2, scenario=case.name, quantity=name, ours=ours, note=f"against {whose}").against(theirs, 0)
        for name, ours, theirs, whose in counts
    ]


def evaluator(case: Released, seen: Observations, published: Published) -> list[Finding]:
    """Check 3: our metrics of the released prediction."""
    require(case.root, case.prediction)
    positions = read_prediction(case.prediction, seen.scenario.frame_count, len(seen.nodes))
    trajectory = Trajectory(positions=positions, frame_count=len(positions))
    scores = metrics.score(trajectory, seen, "released", 0)
    missing = {} if seen.tracks.shape[1] else {"track_error": f"no annotated tracks in {phystwin.TRACKS}, or no such file"}
    return of_scores(3, case.name, scores, DISTANCES, published, missing)


def simulator(case: Released, seen: Observations, device: str) -> list[Finding]:
    """Check 6: replays of the checkpoint against the released prediction, dampings truncated to whole numbers as released, and not.

    What the order of additions alone changes is measured by a replay with the springs in another order.
    """
    require(case.root, case.parameters, case.checkpoint, case.prediction)
    parameters, checkpoint = read_parameters(case.parameters), read_checkpoint(case.checkpoint)
    released = read_prediction(case.prediction, seen.scenario.frame_count, len(seen.nodes))
    twin = released_twin(seen, parameters, checkpoint, case)
    truncated = damped(twin, *(float(int(parameters[key])) for key in ("drag_damping", "dashpot_damping")))
    first = replay(truncated, seen.controller_points, device, case.name)
    second = replay(_reordered(truncated), seen.controller_points, device, f"{case.name}, other order")
    exact = replay(twin, seen.controller_points, device, f"{case.name}, float damping")
    order = _apart(first.positions, second.positions).mean(axis=1)
    found = [*_replayed(case.name, "dampings truncated", first, released, order)]
    found.append(_largest(case.name, "mean distance of nodes, springs in another order", order))
    whole = truncated.material.drag == twin.material.drag and np.array_equal(truncated.material.dashpot, twin.material.dashpot)
    note = "both dampings are whole numbers: the same replay" if whole else ""
    for name, values in _distances("float dampings", _apart(exact.positions, released)).items():
        found.append(_largest(case.name, name, values, "; ".join(filter(None, (note, exact.reason)))))
    return found


def released_twin(seen: Observations, parameters: dict[str, float], checkpoint: Checkpoint, case: Released) -> Twin:
    """The checkpoint as a twin, dampings as searched. Raises InputError where springs and checkpoint do not belong together."""
    springs = _springs(seen, parameters)
    if len(springs.springs) != len(checkpoint.stiffness):
        rule = f"one stiffness for each of the {len(springs.springs)} rebuilt springs is required"
        raise InputError(case.checkpoint, rule, len(checkpoint.stiffness), "See check 2.")
    if checkpoint.contact is None:
        raise InputError(case.checkpoint, "the four scalars of contact are required", "not all of them")
    material = Material(
        stiffness=checkpoint.stiffness.clip(*Fit().stiffness_range),
        dashpot=np.full(len(checkpoint.stiffness), parameters["dashpot_damping"]),
        drag=parameters["drag_damping"],
        contact_distance=parameters["collision_dist"],
        **checkpoint.contact,  # type: ignore[arg-type]
    )
    scenario = seen.scenario
    simulation = Simulation(
        frame_time=RELEASED_FRAME_TIME,
        substeps=RELEASED_SUBSTEPS,
        up=scenario.up,
        ground=scenario.ground,
        self_collision=scenario.self_collision,
    )
    return Twin(topology=springs, material=material, simulation=simulation)


def damped(twin: Twin, drag: float, dashpot: float) -> Twin:
    """The twin with other dampings, 1/s and N s/m."""
    material = replace(twin.material, drag=drag, dashpot=np.full(len(twin.material.dashpot), dashpot))
    return replace(twin, material=material)


def replay(twin: Twin, controller_points: np.ndarray, device: str, label: str) -> Trajectory:
    """As the released simulator would: without asking whether the substep is within our bound."""
    progress = Progress(f"replay {label}", len(controller_points) - 1)
    return simulate(twin, controller_points, device, progress.update)


def _springs(seen: Observations, parameters: dict[str, float]) -> Topology:
    return uniform_topology(
        seen.nodes,
        seen.controller_points[0],
        parameters["object_radius"],
        int(parameters["object_max_neighbours"]),
        parameters["controller_radius"],
        int(parameters["controller_max_neighbours"]),
    )


def _reordered(twin: Twin) -> Twin:
    """The same springs, each kind in reverse order."""
    inner, total = twin.topology.object_spring_count, len(twin.topology.springs)
    order = np.concatenate([np.arange(inner)[::-1], np.arange(inner, total)[::-1]])
    graph, material = twin.topology, twin.material
    return replace(
        twin,
        topology=replace(graph, springs=graph.springs[order], rest_lengths=graph.rest_lengths[order]),
        material=replace(material, stiffness=material.stiffness[order], dashpot=material.dashpot[order]),
    )


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of each node in each frame that both have [F, N], m."""
    shared = min(len(a), len(b))
    distance: np.ndarray = np.linalg.norm(a[:shared].astype(np.float64) - b[:shared], axis=2)
    return distance


def _distances(label: str, apart: np.ndarray) -> dict[str, np.ndarray]:
    return {
        f"mean distance of nodes, {label}": apart.mean(axis=1),
        f"largest distance of a node, {label}": apart.max(axis=1),
    }


def _replayed(scenario: str, label: str, own: Trajectory, released: np.ndarray, order: np.ndarray) -> list[Finding]:
    """The mean distance, judged in the frame where it exceeds most what is allowed there; the largest, as it is."""
    (name, mean), (other, largest) = _distances(label, _apart(own.positions, released)).items()
    # Until the next frame: which of two replays flips a contact first is chance.
    reached = np.maximum.accumulate(np.append(order[1:], order[-1]))
    allowed = POSITION + SPREAD * np.pad(reached, (0, len(mean) - len(order)), mode="edge")
    worst = int(np.argmax(mean / allowed))
    rule = f"allowed: {POSITION:g} m and {SPREAD:g} times what the order of springs changes"
    found = _at(scenario, name, mean, worst, rule).against(0.0, float(allowed[worst]))
    if own.diverged_frame is not None:
        found = replace(found, outcome="failed", note=own.reason)
    overflow = f"{own.collision_overflow} collision candidates did not fit" if own.collision_overflow else ""
    return [found, _largest(scenario, other, largest, overflow)]


def _largest(scenario: str, quantity: str, per_frame: np.ndarray, note: str = "") -> Finding:
    return _at(scenario, quantity, per_frame, int(np.argmax(per_frame)), note)


def _at(scenario: str, quantity: str, per_frame: np.ndarray, frame: int, note: str) -> Finding:
    """A distance in one frame, measured."""
    note = "; ".join(filter(None, (f"frame {frame}", note)))
    value = float(per_frame[frame])
    return Finding(check=6, scenario=scenario, quantity=quantity, unit="m", ours=value, note=note, per_frame=per_frame)
