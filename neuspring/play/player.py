"""The recording in the scene: runs side by side, at a frame of the clock."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from neuspring.core.artifacts import Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.play.body import Body
from neuspring.play.clock import Clock
from neuspring.play.colors import Scale, Springs, region_legend, scale_of, strain_scale
from neuspring.play.dress import Dress
from neuspring.play.results import Run, Scene
from neuspring.play.surroundings import Surroundings
from neuspring.play.tracked import Tracked

if TYPE_CHECKING:
    import viser

ROOM = 1.1
"""The first view shows so much of what the runs fill."""
SAMPLES = 12
"""Frames that the range of strain and force is taken from."""
MOST_SHOWN = 8
"""Runs that are shown at once."""


@dataclass
class Look:
    """What is shown, and how."""

    quantity: str = "stiffness"
    nodes: bool = True
    springs: bool = True
    hands: bool = True
    splats: bool = False
    points: bool = True
    tracks: bool = True
    cameras: bool = True
    images: bool = False
    gap: float = 1.2
    """Distance between runs, as a part of the scene's size; 0: all in one place."""
    shown: list[str] = field(default_factory=list)
    """Names of runs."""


class Player:
    """Draws the shown runs at the clock's frame. All methods may be called from any thread."""

    def __init__(self, scene: viser.SceneApi, found: Scene) -> None:
        scenario = found.observations.scenario
        self.found, self.lock = found, threading.RLock()
        self.clock = Clock(scenario.frame_count, scenario.frame_rate, scenario.train_end)
        self.look = Look(shown=list(found.shown))
        self.scale: Scale | None = None
        self.notes: dict[str, str] = {}
        """Run -> why it is not shown, or what to know about it."""
        self._scene, self._bodies, self._tracked = scene, dict[str, Body](), dict[str, Tracked]()
        self._hidden = False
        self.limit: float | None = None
        """Strain at the end of the colors of a live twin; None: the recording is shown."""
        seen = found.observations
        everything = np.concatenate([seen.object_points[seen.object_visibility], seen.nodes])
        self.low, self.high = everything.min(axis=0), everything.max(axis=0)
        self.size = max(float(np.linalg.norm(self.high - self.low)), 0.05)
        self.around = Surroundings(scene, seen, found.capture, self.size)
        if scenario.ground:
            x, y, _ = 0.5 * (self.low + self.high)
            wide = 6 * self.size
            scene.add_grid("/ground", width=wide, height=wide, cell_size=0.1, section_size=0.5, position=(float(x), float(y), 0.0))
        self.apply()

    def run(self, name: str) -> Run:
        """A run by name."""
        return next(run for run in self.found.runs if run.name == name)

    def apply(self) -> None:
        """Make the scene agree with the look."""
        with self.lock:
            wanted = self.look.shown[:MOST_SHOWN]
            for name in [name for name in self._bodies if name not in wanted]:
                self._bodies.pop(name).remove()
                self._tracked.pop(name)
            for name in wanted:
                if name not in self._bodies:
                    self._add(self.run(name))
            look = self.look
            for index, name in enumerate(name for name in wanted if name in self._bodies):
                body = self._bodies[name]
                self.dress(body, self.run(name))
                body.show(nodes=look.nodes, springs=look.springs, hands=look.hands, splats=look.splats)
                self._tracked[name].show(look.tracks)
                body.root.position, body.root.visible = self.offset(index), not self._hidden
            seen = not self._hidden
            self.around.show(
                points=look.points and seen, tracks=look.tracks and seen, cameras=look.cameras, images=look.images and seen
            )
            self.scale = self._scale()
            self.draw()

    def dress(self, body: Body, run: Run) -> None:
        """Put a run's splats on a body when they are first wanted; what it lacks is a note."""
        if not self.look.splats or body.dress is not None or run.splats_path is None:
            return
        try:
            if run.splats is not None and run.trajectory is not None:
                nodes = run.trajectory.positions[0]
                body.dress = Dress(self._scene, body.name, run.splats, nodes, run.centers)
        except (InputError, NumericalFailure) as error:
            self.notes[run.name] = "; ".join(filter(None, [self.notes.get(run.name, ""), f"no splats: {error}"]))

    def hide(self, hidden: bool, limit: float | None = None) -> None:
        """Take the recording out of sight, for a live twin whose colors end at a strain; time stands still meanwhile."""
        with self.lock:
            self._hidden, self.limit = hidden, limit
            self.clock.playing = False
            self.apply()

    def offset(self, index: int) -> tuple[float, float, float]:
        """Where a run stands: beside the others along y, the first one where it was observed."""
        return (0.0, index * self.look.gap * max(float(self.high[1] - self.low[1]), 0.5 * self.size), 0.0)

    def view(self, opening: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Up [3], the middle of the shown runs [3], m, and from where all are seen [3], m, with an angle of view, rad."""
        sign = 1.0 if self.found.observations.scenario.up == "+z" else -1.0
        last = np.array(self.offset(max(min(len(self.look.shown), MOST_SHOWN) - 1, 0)))
        middle, reach = 0.5 * (self.low + self.high + last), self.size + float(np.linalg.norm(last))
        way = np.array([1.0, -0.35, 0.45 * sign])
        distance = ROOM * 0.5 * reach / math.tan(opening / 2)
        return np.array([0.0, 0.0, sign]), middle, middle + distance * way / np.linalg.norm(way)

    def draw(self) -> None:
        """Show the clock's frame."""
        with self.lock:
            frame = self.clock.frame
            hands = self.found.observations.controller_points[frame]
            for name, body in self._bodies.items():
                nodes = self._positions(self.run(name), frame)
                body.move(nodes, hands, self.look.quantity, self.scale)
                self._tracked[name].move(nodes, frame)
                if body.dress is not None:
                    body.dress.move(nodes, frame)
            self.around.move(frame)

    def legend(self) -> str:
        """The legend of the springs' colors as HTML."""
        twins = [body.twin for body in self._bodies.values() if body.twin]
        if not twins or not self.look.springs:
            return ""
        if self.scale is None:
            return region_legend(twins[0])
        hidden = sum(body.left_out for body in self._bodies.values())
        note = f"<div style='margin:0 .6em;font-size:.8em'>{hidden} springs are not drawn</div>" if hidden else ""
        return self.scale.legend() + note

    def errors(self) -> str:
        """The track error of each shown run in the shown frame, mm, in words; empty without tracks."""
        with self.lock:
            found = {name: one.error for name, one in self._tracked.items() if one.error is not None and not self._hidden}
        return "; ".join(f"{name} {1e3 * error:.1f} mm" for name, error in found.items())

    def _add(self, run: Run) -> None:
        """Put a run into the scene; what it lacks is a note."""
        notes = list(run.notes)
        try:
            if run.trajectory is None or not len(run.trajectory.positions):
                self.notes[run.name] = "; ".join(notes) or "no prediction"
                return
            twin = self._twin(run, notes)
            if run.trajectory.diverged_frame is not None:
                notes.append(f"left the scene in frame {run.trajectory.diverged_frame}; it stays where it was before")
            hands = self.found.observations.controller_points[0]
            nodes = run.trajectory.positions[0]
            body = self._bodies[run.name] = Body(self._scene, run.name, twin, nodes, hands)
            self._tracked[run.name] = Tracked(self._scene, run.name, self.found.observations.tracks, nodes, 1.2 * body.radius)
        except InputError as error:
            notes.append(str(error))
        self.notes[run.name] = "; ".join(notes)

    def _twin(self, run: Run, notes: list[str]) -> Twin | None:
        try:
            twin = run.twin
        except InputError as error:
            notes.append(f"no springs: {error}")
            return None
        if twin is None:
            return None
        assert run.trajectory is not None
        counts = (len(twin.topology.nodes), len(twin.topology.controllers))
        found = (run.trajectory.positions.shape[1], self.found.observations.controller_points.shape[1])
        if counts != found:
            notes.append(f"no springs: its twin has {counts} nodes and hands, its prediction {found}")
            return None
        return twin

    def _positions(self, run: Run, frame: int) -> np.ndarray:
        assert run.trajectory is not None
        return np.asarray(run.trajectory.positions[min(frame, len(run.trajectory.positions) - 1)])

    def _scale(self) -> Scale | None:
        if self.limit is not None and self.look.quantity == "strain":
            return strain_scale(self.limit)
        parts: list[Springs] = []
        strains = []
        hands = self.found.observations.controller_points
        for name, body in self._bodies.items():
            if body.parts is None:
                continue
            frames = np.unique(np.linspace(0, self.clock.count - 1, SAMPLES).astype(int))
            run, own = self.run(name), body.parts
            parts.append(own)
            strains.append(np.stack([own.strain(own.ends(self._positions(run, t), hands[t])) for t in frames]))
        return scale_of(self.look.quantity, parts, strains)
