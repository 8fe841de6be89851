"""The simulators of the benchmark table, its scenes, and a run of its command."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.distance import cdist

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError
from neuspring.physics import reference
from neuspring.twin.candidates import SearchProblem
from neuspring.twin.search import SearchResult
from tests.benchmarks import bench, crowds, rows, sections, table
from tests.benchmarks.ours import Ours, reference_frame
from tests.benchmarks.phystwin import DEVICE, PACKAGE, SETTINGS, SIMULATOR, PhysTwin, single_dashpot
from tests.benchmarks.rows import Bench, Entry, timed
from tests.benchmarks.scenes import GAP, SPACING, box, sheet
from tests.benchmarks.simulators import Frame, Times, distances, gradient_difference
from tests.support.small import search_problem

STAND_IN = f"""
import warp as wp
from qqtt.utils import logger, cfg
wp.init()
{DEVICE}
where = wp.get_device()


@wp.kernel
def lift(x: wp.array(dtype=wp.vec3), y: wp.array(dtype=float), after: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    after[i] = x[i] + wp.vec3(0.0, 0.0, y[i])


@wp.kernel
def heights(x: wp.array(dtype=wp.vec3), total: wp.array(dtype=float)):
    z = x[wp.tid()][2]
    wp.atomic_add(total, 0, 0.5 * z * z)


class State:
    pass


class SpringMassSystemWarp:
    def __init__(self, points, springs, lengths, masses, dt, substeps, stiffness, *scalars, num_object_points, **options):
        assert where == wp.get_device("cpu") and str(cfg.device) == "cpu" and len(scalars) == 4
        self.count, self.object_collision_flag = num_object_points, options["self_collision"]
        logger.info("made")
        self.wp_init_vertices = wp.array(points[: self.count].numpy(), dtype=wp.vec3)
        self.wp_init_velocities = None
        self.wp_spring_Y = wp.array(stiffness[: self.count], dtype=float, requires_grad=True)
        self.start, last = wp.zeros(self.count, dtype=wp.vec3), State()
        last.wp_x = wp.zeros(self.count, dtype=wp.vec3, requires_grad=True)
        self.wp_states, self.loss = [last], wp.zeros(1, dtype=float, requires_grad=True)

    def set_init_state(self, x, v, pure_inference):
        wp.copy(self.start, x)

    def set_controller_target(self, frame, pure_inference):
        assert frame == 1

    def step(self):
        wp.launch(lift, self.count, [self.start, self.wp_spring_Y], [self.wp_states[-1].wp_x])

    def calculate_simple_loss(self):
        wp.launch(heights, self.count, [self.wp_states[-1].wp_x], [self.loss])

    def clear_loss(self):
        self.loss.zero_()
"""
"""Made up: node i rises by the stiffness of spring i, and the loss is half the sum of the squared heights."""


@pytest.fixture
def checkout(tmp_path):
    """A folder with the files and the names of the peer, and another simulator."""
    contents = {
        SIMULATOR: STAND_IN,
        SETTINGS[0]: "from .misc import single\n\n\nclass Settings:\n    pass\n\n\ncfg = single(Settings)\n",
        SETTINGS[1]: "def single(kind):\n    return kind()\n",
    }
    for name, text in contents.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    # The checkout's own utilities import what is not here: they must not be used.
    (tmp_path / PACKAGE / "utils" / "__init__.py").write_text("import viewers_that_nobody_has\n")
    return tmp_path


def tiny() -> tuple[Twin, np.ndarray]:
    return box(30, 10, 8)


def test_a_peer_runs_from_a_copy_of_its_checkout(checkout):
    twin, hands = tiny()
    count, stiffness = len(twin.topology.nodes), twin.material.stiffness
    files = {path: path.read_text() for path in checkout.rglob("*.py")}
    device, peer = wp.get_device(), PhysTwin(checkout)
    ahead, learning = peer.forward(twin, hands), peer.forward_backward(twin, hands)
    wanted = twin.topology.nodes + np.pad(stiffness[:count, None], ((0, 0), (2, 0)))
    for frame in (ahead, learning, learning):
        frame.run()
        np.testing.assert_allclose(frame.positions(), wanted, rtol=1e-6)
    assert learning.gradient is not None
    # Run twice: gradients do not add up. d(z^2 / 2) / dY = z.
    np.testing.assert_allclose(learning.gradient(), wanted[:, 2], rtol=1e-6)
    assert {path: path.read_text() for path in checkout.rglob("*.py")} == files
    # The process is as it was: for another copy, and for kernels that carry their own adjoints.
    assert not [name for name in sys.modules if name.split(".")[0] == PACKAGE]
    assert wp.get_device() == device and wp.config.enable_backward is False


def test_a_folder_that_is_no_checkout_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"--peer: must be a checkout of PhysTwin.*Give the folder that git clone made"):
        PhysTwin(tmp_path)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        (STAND_IN.replace(DEVICE, "wp.set_device('cuda:1')"), "must name its device by"),
        (STAND_IN.replace("class SpringMassSystemWarp", "class Other"), "must define SpringMassSystemWarp"),
    ],
)
def test_another_version_of_the_peer_is_refused(checkout, text, rule):
    (checkout / SIMULATOR).write_text(text)
    with pytest.raises(InputError, match=rule):
        PhysTwin(checkout)


def test_a_twin_that_the_peer_cannot_simulate_is_refused():
    twin, _ = tiny()
    assert single_dashpot(twin) == 0.5
    uneven = replace(twin.material, dashpot=np.linspace(0, 1, len(twin.material.dashpot)))
    with pytest.raises(InputError, match=r"material\.dashpot: the peer has one for all springs"):
        single_dashpot(replace(twin, material=uneven))
    for other in ({"gravity": 1.6}, {"ground": False}, {"controller_velocity": True}):
        with pytest.raises(InputError, match="simulation: the peer has a ground"):
            single_dashpot(replace(twin, simulation=replace(twin.simulation, **other)))


def test_our_frame_is_that_of_the_reference_and_its_gradient_is_that_of_the_loss():
    twin, hands = tiny()
    ahead, learning = Ours().forward(twin, hands), Ours().forward_backward(twin, hands)
    ahead.run()
    learning.run()
    nodes = twin.topology.nodes.astype(np.float64)

    def after(scale: float = 1.0) -> np.ndarray:
        body = replace(twin, material=replace(twin.material, stiffness=scale * twin.material.stiffness))
        return reference.frame(reference.ReferenceTwin.of(body), nodes, np.zeros_like(nodes), *hands)[0]

    # A few roundings of positions of 0.1 m.
    assert np.abs(ahead.positions() - after()).max() < 1e-7
    specified = reference_frame(twin, hands)
    specified.run()
    np.testing.assert_array_equal(specified.positions(), after())
    assert not distances(ahead, learning).any()
    # Log stiffness up and down by a hundredth for all springs; positions are below 1 m, so the loss is half the mean square.
    up, down = (np.mean(after(scale) ** 2) / 2 for scale in (np.exp(0.01), np.exp(-0.01)))
    assert learning.gradient is not None
    assert learning.gradient().sum() == pytest.approx((up - down) / 0.02, rel=1e-3)
    learning.run()
    assert gradient_difference(learning, learning) == 0


def test_a_folded_sheet_has_two_layers_in_contact_and_no_spring_between_them():
    twin, hands = sheet(500, 67)
    nodes, springs = twin.topology.nodes, twin.topology.springs[: twin.topology.object_spring_count]
    columns = int(500**0.5)
    column = np.arange(len(nodes)) // (len(nodes) // columns)
    lower, upper = column < columns // 2 - 2, column > columns // 2 + 2
    np.testing.assert_allclose(nodes[upper, 2].mean() - nodes[lower, 2].mean(), GAP, rtol=1e-3)
    nearest = cdist(nodes[upper], nodes[lower]).min(axis=1)
    assert np.mean(nearest < twin.material.contact_distance) > 0.9
    assert np.abs(np.diff(column[springs], axis=1)).max() <= 3
    # Rest lengths are those of the flat sheet: at its corners, nodes ask along the edges.
    assert twin.topology.rest_lengths[: len(springs)].max() < 4 * SPACING
    assert hands.shape == (2, len(twin.topology.controllers), 3)


def test_the_first_of_several_twins_moves_as_if_alone():
    """Whatever the topologies of the others; and its gradient is that of its own loss, in the order of its own springs."""
    scenes = [box(30, 10, size) for size in (8, 5, 12)]
    (twin, hands), alone, crowd = scenes[0], Ours(), [twin for twin, _ in scenes]
    assert len({len(one.topology.springs) for one in crowd}) == 3
    for gradient in (False, True):
        single, several = rows.frame_of(alone, twin, hands, gradient), alone.together(crowd, hands, gradient=gradient)
        for frame in (single, several, several):
            frame.run()
        assert not distances(single, several).any() and (several.gradient is None) != gradient
    assert gradient_difference(several, single) < 1e-6


def test_sections_of_several_twins_name_what_they_are_beside_and_agree_with_it(monkeypatch):
    monkeypatch.setitem(crowds.CASES, "a", (40, 5, 8))
    its = Bench("cpu", Ours(), Ours(), quick=True)
    for section, count in ((sections.frames, 7), (crowds.by_batch, 4), (crowds.by_topologies, 4)):
        made = section(its)
        assert len(made) == count and {row.reference for row in made} <= {"", *(row.name for row in made)}
    # On a CPU no bit of a twin depends on those beside it; the specification is in float64.
    same = [note for note in its.notes if "agree" in note and "NumPy" not in note]
    assert len(same) == 6 and all("to 0.0e+00 m" in note for note in same)


def test_a_search_has_the_same_costs_in_every_company(monkeypatch):
    def small(rollouts: int, device: str) -> SearchProblem:
        problem = search_problem(device=device)
        return replace(problem, search=replace(problem.search, rollouts=rollouts))

    monkeypatch.setattr(crowds, "problem", small)
    its = Bench("cpu", Ours(), quick=True)
    found = crowds.of_search(its)
    assert [row.reference for row in found] == ["", found[0].name, found[0].name] and all(row.median > 0 for row in found)
    assert its.notes[0].startswith(f"search, cpu: {crowds.GENERATION} rollouts of {found[0].nodes} nodes over 4 frames")
    real = crowds.search

    def spoiled(problem: SearchProblem, seed: int) -> SearchResult:
        result = real(problem, seed)
        result.trace.loc[3, "cost"] *= 1 if problem.together else 1 + 1e-15
        return result

    monkeypatch.setattr(crowds, "search", spoiled)
    with pytest.raises(AssertionError, match="in lanes, one thread: costs differ"):
        crowds.of_search(its)


def test_ratios_are_per_twin_and_medians_of_the_rounds(monkeypatch):
    twin, _ = tiny()
    seconds = {"alone": (1.0, 2.0, 3.0), "four": (2.0, 4.0, 60.0)}
    monkeypatch.setattr(rows, "take_turns", lambda actions, *_, **__: {name: Times(seconds[name]) for name in actions})
    frame = Frame(lambda: None, lambda: twin.topology.nodes)
    alone, four = timed(Bench("cpu", Ours()), "x", [Entry("alone", twin, frame), Entry("four", twin, frame, "alone", batch=4)])
    # Ratios 2, 2 and 20 of the rounds, four twins: one busy round does not count.
    assert (four.ratio, four.least_ratio, four.median) == (0.5, 0.5, 4000.0)
    assert alone.ratio is None


def test_the_command_prints_and_writes_the_table(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(table, "ROOT", tmp_path)
    monkeypatch.setitem(bench.SECTIONS, "nodes", lambda its: sections._scaling(its, "nodes", [("30 nodes", tiny())]))
    bench.main(["--quick", "--only", "nodes", "--device", "cpu"])
    printed = capsys.readouterr().out
    assert "| nodes   | 30 nodes, forward + backward | cpu " in printed
    assert "is kept" in printed
    (file,) = (tmp_path / table.SCRATCH).glob("*.json")
    assert file.name in printed
    names = {row[1] for row in table.medians(json.loads(file.read_text()))}
    assert names == {"30 nodes, forward", "30 nodes, forward + backward"}
