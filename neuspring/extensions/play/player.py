"""The recording: runs side by side, at the frame of a clock that plays in a loop or is set by the user."""

from __future__ import annotations

import itertools
import math
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from neuspring.core.errors import InputError, NumericalFailure
from neuspring.extensions.play.colors import Scale
from neuspring.extensions.play.layers import BodyLayer, SplatLayer, spacing
from neuspring.report.shown import Found, Run

if TYPE_CHECKING:
    import viser

LEAST_LEVEL = 0.02
"""Smallest horizontal component of the first view's direction, as a fraction of the vertical one."""
MOST_RUNS_SHOWN = 8
"""Largest number of runs shown at once."""


@dataclass
class Clock:
    """Time of a recording of `count` frames at `rate` frames/s; future frames begin at `border`."""

    count: int
    rate: float
    border: int
    time: float = 0.0
    """Time since frame 0, in frames, with fractions."""
    playing: bool = False

    @property
    def frame(self) -> int:
        """The shown frame."""
        return min(int(self.time), self.count - 1)

    def advance(self, seconds: float) -> bool:
        """Advance time, from the last frame to the first; returns True if the frame changed."""
        before = self.frame
        if self.playing:
            self.time = (self.time + max(seconds, 0.0) * self.rate) % self.count
        return self.frame != before

    def show(self, frame: int) -> None:
        """Go to a frame, clipped to the recording."""
        self.time = float(min(max(frame, 0), self.count - 1))

    def bar(self) -> str:
        """Timeline as HTML: training and future frames, their border, and the shown frame."""
        border, here = (100 * value / max(self.count - 1, 1) for value in (self.border - 0.5, self.frame))
        border = min(max(border, 0.0), 100.0)
        part, color = ("training", "#2171b5") if self.frame < self.border else ("future", "#d94801")
        colors = f"linear-gradient(to right, #9ecae1 {border:.2f}%, #fdae6b {border:.2f}%)"
        mark = f"position:absolute;top:-3px;bottom:-3px;width:4px;background:{color};left:calc({here:.2f}% - 2px)"
        return (
            "<div style='margin:.2em .8em .6em;font-size:.8em'>"
            f"<div style='position:relative;height:12px;border-radius:2px;background:{colors}'><div style='{mark}'></div></div>"
            f"<div style='margin-top:6px'><b style='color:{color}'>{part} frame {self.frame} of {self.count - 1}, "
            f"{self.frame / self.rate:.2f} s</b></div>"
            f"<div>blue: training, frames 0 to {self.border - 1}; orange: future, predicted</div></div>"
        )


class Player:
    """Draws the shown runs at the clock's frame; thread-safe."""

    def __init__(self, scene: viser.SceneApi, found: Found) -> None:
        seen, scenario = found.observations, found.observations.scenario
        self.found, self.lock, self.watched = found, threading.RLock(), threading.Event()
        self.watched.set()
        self.clock = Clock(scenario.frame_count, scenario.frame_rate, scenario.train_end)
        self.runs = list(found.shown)
        """Names of the shown runs."""
        self.splats = any("splats" in run.paths for run in found.runs)
        self.springs, self.points = not self.splats, False
        """Switches: splats; springs with nodes and controllers; observed points."""
        self.notes: dict[str, str] = {}
        """Run -> remarks, for example why it is not shown."""
        self.scale: Scale | None = None
        self._scene, self._bodies, self._hidden = scene, dict[str, BodyLayer](), False
        cameras = list(found.capture.cameras.values()) if found.capture else []
        self.seen = seen.object_points[0] if cameras else None
        """Observed points in frame 0 [m, 3], m; None without images."""
        self._eye = cameras[0].camera_to_world[:3, 3] if len(cameras) == 1 else None
        all_hands, holds = seen.controller_points, seen.controller_valid
        hands = all_hands[holds] if holds.size else all_hands.reshape(-1, 3)
        everything = np.concatenate([seen.object_points[seen.object_visibility], seen.nodes, hands])
        self.low, self.high = everything.min(axis=0), everything.max(axis=0)
        self.size = max(float(np.linalg.norm(self.high - self.low)), 0.05)
        radius = min(0.35 * spacing(seen.object_points[0]), 0.006 * self.size)
        look: dict[str, Any] = {"point_size": radius, "point_shape": "circle", "precision": "float32"}
        self._points: Any = scene.add_point_cloud("/observed", seen.object_points[0], (0, 150, 90), **look)
        if scenario.ground:
            x, y, _ = 0.5 * (self.low + self.high)
            wide = 6 * self.size
            scene.add_grid("/ground", width=wide, height=wide, cell_size=0.1, section_size=0.5, position=(float(x), float(y), 0.0))
        self.apply()

    def run(self, name: str) -> Run:
        """A run by name."""
        return next(run for run in self.found.runs if run.name == name)

    def apply(self) -> None:
        """Update the scene from the switches."""
        with self.lock:
            wanted = self.runs[:MOST_RUNS_SHOWN]
            for name in [name for name in self._bodies if name not in wanted]:
                self._bodies.pop(name).remove()
            for name in wanted:
                if name not in self._bodies:
                    self._add(self.run(name))
            stiffness = [body.stiffness for body in self._bodies.values() if len(body.stiffness)]
            self.scale = Scale.of(stiffness) if stiffness else None
            for index, name in enumerate(name for name in wanted if name in self._bodies):
                body = self._bodies[name]
                self.dress(body, self.run(name))
                body.root.position, body.root.visible = self.offset(index), not self._hidden
            self._points.visible = self.points and not self._hidden
            self.draw()

    def dress(self, body: BodyLayer, run: Run, *, springs: bool = False) -> None:
        """Show the selected parts of a run, and load its splats on first use; `springs`: always show them."""
        if self.splats and body.splats is None and "splats" in run.paths:
            try:
                if run.splats is not None and run.trajectory is not None:
                    nodes = run.trajectory.positions[0]
                    body.splats = SplatLayer(self._scene, body.name, run.splats, nodes, run.centers, self.seen)
            except (InputError, NumericalFailure) as error:
                self.notes[run.name] = "; ".join(filter(None, [self.notes.get(run.name, ""), f"no splats: {error}"]))
        body.show(self.springs or springs, self.splats)
        if len(body.stiffness):
            body.paint(self.scale or Scale.of([body.stiffness]))

    def hide(self, hidden: bool) -> None:
        """Hide or show the recording; hidden, it pauses for a live twin."""
        with self.lock:
            self._hidden, self.clock.playing = hidden, False
            self.apply()

    def offset(self, index: int) -> tuple[float, float, float]:
        """Shift of a run, m: side by side across the view, along x or y; 0 for the first run."""
        right = np.cross((0.0, 0.0, self.found.observations.scenario.up_sign), self._way())
        axis = int(np.abs(right[1]) >= np.abs(right[0]))
        wide = max(float(self.high[axis] - self.low[axis]), 0.5 * self.size)
        shift = index * 1.2 * wide * float(np.sign(right[axis]))
        return (0.0, shift, 0.0) if axis else (shift, 0.0, 0.0)

    def _way(self) -> np.ndarray:
        """Unit direction [3] from the object to the initial view: to a single camera, to show the seen side; else oblique."""
        way = np.array([1.0, -0.35, 0.45 * self.found.observations.scenario.up_sign])
        if self._eye is not None:
            way = self._eye - 0.5 * (self.low + self.high)
        # A view from straight above would have no up direction.
        if np.linalg.norm(way[:2]) < LEAST_LEVEL * abs(way[2]):
            way[0] += LEAST_LEVEL * abs(way[2])
        return np.asarray(way / np.linalg.norm(way))

    def view(
        self, opening: float, aspect: float = 1.6, covered: float = 0.0, count: int = MOST_RUNS_SHOWN
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Up, look-at point and eye [3], m, of a view that contains the first `count` shown runs.

        `opening`: vertical angle, radians; `aspect`: width over height; `covered`: fraction of the window covered at the bottom.
        """
        sign = float(self.found.observations.scenario.up_sign)
        shifts = np.array([self.offset(index) for index in range(max(min(len(self.runs), count), 1))])
        corners = np.array(list(itertools.product(*zip(self.low, self.high, strict=True))))
        points = (corners + shifts[:, None]).reshape(-1, 3)
        middle, up = 0.5 * (points.min(axis=0) + points.max(axis=0)), np.array([0.0, 0.0, sign])
        way = self._way()
        right = np.cross(up, way) / np.linalg.norm(np.cross(up, way))
        top, half = np.cross(way, right), math.tan(opening / 2)
        x, y, z = np.stack([right, top, way]) @ (points - middle).T
        distance = 1.08 * float(np.max([z + np.abs(x) / (half * aspect), z + np.abs(y) / (half * (1 - covered))]))
        look_at = middle - covered * half * distance * top
        return up, look_at, look_at + distance * way

    def draw(self) -> None:
        """Draw the clock's frame."""
        with self.lock:
            frame, seen = self.clock.frame, self.found.observations
            for name, body in self._bodies.items():
                trajectory = self.run(name).trajectory
                assert trajectory is not None
                nodes = trajectory.positions[min(frame, len(trajectory.positions) - 1)]
                body.move(nodes, seen.controller_points[frame])
                if body.splats is not None:
                    body.splats.move(nodes, frame)
            if self._points.visible:
                self._points.points = seen.object_points[frame][seen.object_visibility[frame]]

    def _add(self, run: Run) -> None:
        """Add a run to the scene; missing parts become notes."""
        notes, hands = list(run.notes), self.found.observations.controller_points[0]
        try:
            if run.trajectory is None or not len(run.trajectory.positions):
                self.notes[run.name] = "; ".join(notes) or "no prediction"
                return
            nodes = run.trajectory.positions[0]
            if run.trajectory.diverged_frame is not None:
                notes.append(f"diverged in frame {run.trajectory.diverged_frame}; later frames show its last position")
            twin = None
            try:
                twin = run.twin
                if twin and (len(twin.topology.nodes), len(twin.topology.controllers)) != (len(nodes), len(hands)):
                    notes.append(
                        f"no springs: twin and prediction must have the same {len(nodes)} nodes and {len(hands)} controllers"
                    )
                    twin = None
            except InputError as error:
                notes.append(f"no springs: {error}")
            self._bodies[run.name] = BodyLayer(self._scene, run.name, twin, nodes, hands)
        except InputError as error:
            notes.append(str(error))
        self.notes[run.name] = "; ".join(notes)
