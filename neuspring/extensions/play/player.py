"""The recording in the scene: runs side by side, at a frame of a clock that runs, is scrubbed, and starts again at the end."""

from __future__ import annotations

import itertools
import math
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from neuspring.core.errors import InputError, NumericalFailure
from neuspring.extensions.play.colors import Scale, region_legend, scale_of, strain_scale
from neuspring.extensions.play.layers import BodyLayer, Display, SplatLayer, Surroundings, TrackOverlay
from neuspring.report.shown import Found, Run

if TYPE_CHECKING:
    import viser

SPEEDS = {"0.1 ×": 0.1, "0.25 ×": 0.25, "0.5 ×": 0.5, "1 ×": 1.0, "2 ×": 2.0, "4 ×": 4.0}
ROOM = 1.08
"""The first view shows so much of what the runs fill."""
WAY = (1.0, -0.35, 0.45)
"""Direction of the first view: across the row of runs, from above."""
LEAST_LEVEL = 0.02
"""Least level part of the first view's direction, of its vertical part."""
RANGE_SAMPLES = 12
"""Frames that the range of strain and force is taken from."""
MOST_RUNS_SHOWN = 8
"""Runs that are shown at once."""


@dataclass
class Clock:
    """Time of a recording of `count` frames at `rate` frames/s, whose frames from `border` on are future frames."""

    count: int
    rate: float
    border: int
    time: float = 0.0
    """Frames since frame 0, with fractions."""
    speed: float = 1.0
    playing: bool = False
    loop: bool = True

    @property
    def frame(self) -> int:
        """The frame that is shown."""
        return min(int(self.time), self.count - 1)

    def advance(self, seconds: float) -> bool:
        """Let time pass; returns whether the frame has changed."""
        if not self.playing:
            return False
        before, self.time = self.frame, self.time + max(seconds, 0.0) * self.speed * self.rate
        if self.time >= self.count:
            self.time %= self.count
            if not self.loop:
                self.time, self.playing = float(self.count - 1), False
        return self.frame != before

    def show(self, frame: int) -> None:
        """Go to a frame; outside ones are the first or the last."""
        self.time = float(min(max(frame, 0), self.count - 1))

    @property
    def part(self) -> str:
        """The part of the recording that the frame belongs to."""
        return "training" if self.frame < self.border else "future"

    def text(self) -> str:
        """Frame, time and part in words."""
        return f"{self.part} frame {self.frame} of {self.count - 1}, {self.frame / self.rate:.2f} s"

    def bar(self) -> str:
        """The timeline as HTML: training and future, the border between them, and where we are."""
        border, here = (100 * value / max(self.count - 1, 1) for value in (self.border - 0.5, self.frame))
        border = min(max(border, 0.0), 100.0)
        colors = f"linear-gradient(to right, #9ecae1 {border:.2f}%, #fdae6b {border:.2f}%)"
        mark = "position:absolute;top:-3px;bottom:-3px;width:{w}px;background:{c};left:calc({x:.2f}% - {h}px)"
        color = "#2171b5" if self.part == "training" else "#d94801"
        return (
            "<div style='margin:.2em .8em .6em;font-size:.8em'>"
            f"<div style='position:relative;height:12px;border-radius:2px;background:{colors}'>"
            f"<div style='{mark.format(w=2, c='#333', x=border, h=1)}'></div>"
            f"<div style='{mark.format(w=4, c=color, x=here, h=2)}'></div></div>"
            f"<div style='margin-top:6px'><b style='color:{color}'>{self.text()}</b></div>"
            f"<div>blue: training, frames 0 to {self.border - 1}; orange: future, predicted</div></div>"
        )


class Player:
    """Draws the shown runs at the clock's frame. All methods may be called from any thread."""

    def __init__(self, scene: viser.SceneApi, found: Found) -> None:
        scenario = found.observations.scenario
        self.found, self.lock, self.watched = found, threading.RLock(), threading.Event()
        self.watched.set()
        self.clock = Clock(scenario.frame_count, scenario.frame_rate, scenario.train_end)
        bare = not any("splats" in run.paths for run in found.runs)
        plain: Any = dict.fromkeys(("nodes", "springs", "hands", "points", "tracks"), bare)
        self.display = Display(runs=list(found.shown), splats=not bare, **plain)
        self.scale: Scale | None = None
        self.notes: dict[str, str] = {}
        """Run -> why it is not shown, or what to know about it."""
        self._scene, self._bodies = scene, dict[str, BodyLayer]()
        self._hidden = False
        self.limit: float | None = None
        """Strain at the end of the colors of a live twin; None: the recording is shown."""
        seen = found.observations
        cameras = list(found.capture.cameras.values()) if found.capture else []
        self.seen = seen.object_points[0] if cameras else None
        """Points that cameras saw in frame 0 [m, 3], m; None: there are no images."""
        self._eye = cameras[0].camera_to_world[:3, 3] if len(cameras) == 1 else None
        all_hands, holds = seen.controller_points, seen.controller_valid
        hands = all_hands[holds] if holds.size else all_hands.reshape(-1, 3)
        everything = np.concatenate([seen.object_points[seen.object_visibility], seen.nodes, hands])
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
        """Make the scene agree with the display."""
        with self.lock:
            wanted = self.display.runs[:MOST_RUNS_SHOWN]
            for name in [name for name in self._bodies if name not in wanted]:
                self._bodies.pop(name).remove()
            for name in wanted:
                if name not in self._bodies:
                    self._add(self.run(name))
            for index, name in enumerate(name for name in wanted if name in self._bodies):
                body = self._bodies[name]
                self.add_splats(body, self.run(name))
                body.show(self.display)
                body.root.position, body.root.visible = self.offset(index), not self._hidden
            self.around.show(self.display, hidden=self._hidden)
            self.scale = self._scale()
            self.draw()

    def add_splats(self, body: BodyLayer, run: Run) -> None:
        """Give a body the run's splats when they are first wanted; what it lacks is a note."""
        if not self.display.splats or body.splats is not None or "splats" not in run.paths:
            return
        try:
            if run.splats is not None and run.trajectory is not None:
                nodes = run.trajectory.positions[0]
                body.splats = SplatLayer(self._scene, body.name, run.splats, nodes, run.centers, self.seen)
        except (InputError, NumericalFailure) as error:
            self.notes[run.name] = "; ".join(filter(None, [self.notes.get(run.name, ""), f"no splats: {error}"]))

    def hide(self, hidden: bool, limit: float | None = None) -> None:
        """Take the recording out of sight, for a live twin whose colors end at a strain; time stands still meanwhile."""
        with self.lock:
            self._hidden, self.limit = hidden, limit
            self.clock.playing = False
            self.apply()

    def offset(self, index: int) -> tuple[float, float, float]:
        """Shift of a run, m: it stands beside the others, across the view, along x or y; the first one where it was observed."""
        right = np.cross((0.0, 0.0, self.found.observations.scenario.up_sign), self._way())
        axis = int(np.abs(right[1]) >= np.abs(right[0]))
        wide = max(float(self.high[axis] - self.low[axis]), 0.5 * self.size)
        shift = index * self.display.gap * wide * float(np.sign(right[axis]))
        return (0.0, shift, 0.0) if axis else (shift, 0.0, 0.0)

    def _way(self) -> np.ndarray:
        """Unit direction [3] from the body to the first view: where the only camera stood, which did not see the back, else WAY."""
        way = np.array(WAY) * (1.0, 1.0, self.found.observations.scenario.up_sign)
        if self._eye is not None:
            way = self._eye - 0.5 * (self.low + self.high)
        # Straight from above nothing says which side is up.
        if np.linalg.norm(way[:2]) < LEAST_LEVEL * abs(way[2]):
            way[0] += LEAST_LEVEL * abs(way[2])
        return np.asarray(way / np.linalg.norm(way))

    def view(
        self, opening: float, aspect: float = 1.0, covered: float = 0.0, count: int = MOST_RUNS_SHOWN
    ) -> tuple[np.ndarray, ...]:
        """Up [3], where to look [3], m, and from where [3], m, so that the first `count` shown runs fill the window in all frames.

        `opening` is the vertical angle of view, rad, `aspect` width over height; a panel hides the lower part `covered` of it.
        """
        sign = self.found.observations.scenario.up_sign
        shifts = np.array([self.offset(index) for index in range(max(min(len(self.display.runs), count), 1))])
        corners = np.array(list(itertools.product(*zip(self.low, self.high, strict=True))))
        points = (corners + shifts[:, None]).reshape(-1, 3)
        middle, up = 0.5 * (points.min(axis=0) + points.max(axis=0)), np.array([0.0, 0.0, sign])
        way = self._way()
        right = np.cross(up, way) / np.linalg.norm(np.cross(up, way))
        top, half = np.cross(way, right), math.tan(opening / 2)
        x, y, z = np.stack([right, top, way]) @ (points - middle).T
        distance = ROOM * float(np.max([z + np.abs(x) / (half * aspect), z + np.abs(y) / (half * (1 - covered))]))
        look_at = middle - covered * half * distance * top
        return up, look_at, look_at + distance * way

    def draw(self) -> None:
        """Show the clock's frame."""
        with self.lock:
            frame = self.clock.frame
            hands = self.found.observations.controller_points[frame]
            for name, body in self._bodies.items():
                nodes = self._positions(self.run(name), frame)
                body.move(nodes, hands, self.display.quantity, self.scale)
                if body.overlay is not None:
                    body.overlay.move(nodes, frame)
                if body.splats is not None:
                    body.splats.move(nodes, frame)
            self.around.move(frame)

    def legend(self) -> str:
        """The legend of the springs' colors as HTML."""
        twins = [body.twin for body in self._bodies.values() if body.twin]
        if not any(body.springs is not None and body.springs.visible for body in self._bodies.values()):
            return ""
        if self.scale is None:
            return region_legend(twins[0])
        hidden = sum(body.left_out for body in self._bodies.values())
        note = f"<div style='margin:0 .6em;font-size:.8em'>{hidden} springs are not drawn</div>" if hidden else ""
        return self.scale.legend() + note

    def errors(self) -> str:
        """The track error of each shown run in the shown frame, mm, in words; empty without tracks."""
        with self.lock:
            overlays = {} if self._hidden else {name: body.overlay for name, body in self._bodies.items() if body.overlay}
            return "; ".join(f"{name} {1e3 * one.error:.1f} mm" for name, one in overlays.items() if one.error is not None)

    def _add(self, run: Run) -> None:
        """Put a run into the scene; what it lacks is a note."""
        notes, seen = list(run.notes), self.found.observations
        try:
            if run.trajectory is None or not len(run.trajectory.positions):
                self.notes[run.name] = "; ".join(notes) or "no prediction"
                return
            nodes, hands = run.trajectory.positions[0], seen.controller_points[0]
            if run.trajectory.diverged_frame is not None:
                notes.append(f"left the scene in frame {run.trajectory.diverged_frame}; it stays where it was before")
            twin = None
            try:
                twin = run.twin
                counts = (len(twin.topology.nodes), len(twin.topology.controllers)) if twin else (len(nodes), len(hands))
                if counts != (len(nodes), len(hands)):
                    notes.append(f"no springs: its twin has {counts} nodes and hands, its prediction {(len(nodes), len(hands))}")
                    twin = None
            except InputError as error:
                notes.append(f"no springs: {error}")
            body = self._bodies[run.name] = BodyLayer(self._scene, run.name, twin, nodes, hands, self.seen)
            body.overlay = TrackOverlay(self._scene, run.name, seen.tracks, nodes, 1.2 * body.radius)
        except InputError as error:
            notes.append(str(error))
        self.notes[run.name] = "; ".join(notes)

    def _positions(self, run: Run, frame: int) -> np.ndarray:
        assert run.trajectory is not None
        return np.asarray(run.trajectory.positions[min(frame, len(run.trajectory.positions) - 1)])

    def _scale(self) -> Scale | None:
        if self.limit is not None and self.display.quantity == "strain":
            return strain_scale(self.limit)
        frames = np.unique(np.linspace(0, self.clock.count - 1, RANGE_SAMPLES).astype(int))
        hands = self.found.observations.controller_points
        bodies = {name: body.parts for name, body in self._bodies.items() if body.parts is not None}
        strains = [
            np.stack([parts.strain(parts.ends(self._positions(self.run(name), t), hands[t])) for t in frames])
            for name, parts in bodies.items()
        ]
        return scale_of(self.display.quantity, list(bodies.values()), strains)
