"""Live mode: a twin is simulated in real time while the user pulls its nodes and hands with the mouse."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from neuspring.core.errors import InputError
from neuspring.extensions.play.layers import BodyLayer
from neuspring.extensions.play.player import Player
from neuspring.extensions.play.simulator import Simulator, hands_of
from neuspring.report.shown import Run
from neuspring.twin.rollout import Diverged

if TYPE_CHECKING:
    import viser

FASTEST_GRAB = 3.0
"""Largest speed of a grab, m/s, because a jump of the mouse would tear the twin."""


class Live:
    """One twin, simulated frame by frame in its own thread. It pauses while no browser has the page open."""

    def __init__(self, server: viser.ViserServer, player: Player, run: Run) -> None:
        twin = run.twin
        if twin is None:
            raise InputError(run.folder, "the run must have a twin", "none", "Choose a method that makes a twin.")
        self.run, self._server, self._player = run, server, player
        self.simulator = Simulator(twin)
        hands = self.simulator.hands
        self.grab = Grab(len(twin.topology.nodes), hands, hands_of(hands, player.found.observations.controller_hand))
        self.message, self.rate = "", 0.0
        self._splat_seconds = 0.0
        self._again, self._stop = threading.Event(), threading.Event()
        self.body = BodyLayer(server.scene, f"live {run.name}", twin, self.simulator.positions, hands)
        self._player.dress(self.body, run, springs=True)
        self._listen()
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the simulation, and remove the twin from the scene."""
        self._stop.set()
        self._thread.join(10)
        self.body.remove()

    def reset(self) -> None:
        """Return to frame 0 before the next step."""
        self._again.set()

    def status(self) -> str:
        """Frame rate, time, held node, message and legend, as HTML."""
        simulator = self.simulator
        wanted = 1 / simulator.twin.simulation.frame_time
        held = f"node {simulator.grabbed} is held (yellow)" if simulator.grabbed >= 0 else "no node is held"
        text = f"<b>{self.rate:.1f}</b> of {wanted:.0f} fps<br>{simulator.frame / wanted:.1f} s; {held}<br>{escape(self.message)}"
        scale = self._player.scale
        return f"<div style='margin:0 .8em;font-size:.8em;overflow-wrap:anywhere'>{text}</div>{scale.legend() if scale else ''}"

    def _listen(self) -> None:
        """Register the drag listeners. Asynchronous functions keep the order of a drag's events."""

        def listener(kind: str) -> Any:
            async def dragged(event: Any) -> None:
                if event.phase == "start":
                    self._take(event, kind)
                if event.phase == "end":
                    self.grab.release(event.client_id)
                else:
                    self.grab.pull(event.client_id, event.end_position)

            return dragged

        self.body.handles().on_drag("left")(listener("node"))
        self.body.nodes.on_drag("left")(listener("node"))
        self.body.hands.on_drag("left")(listener("hand"))

    def _take(self, event: Any, kind: str) -> None:
        """Grab a hand, or the node nearest to the mouse pointer."""
        index, x = event.instance_index, self.simulator.positions
        if kind == "node":
            index = nearest_to_ray(x, event.client.camera.position, event.start_position)
        self.grab.take(event.client_id, kind, index, event.start_position, x[index] if kind == "node" else None)

    def _run(self) -> None:
        frame_time = self.simulator.twin.simulation.frame_time
        ends: deque[float] = deque(maxlen=30)
        due = time.monotonic()
        while not self._stop.is_set():
            if not self._player.watched.wait(0.2):
                continue
            if self._again.is_set():
                self._restart("")
            try:
                self._step(frame_time)
            except Diverged as end:
                self._restart(f"{end}; the simulation restarted")
            except Exception as error:
                self.message = f"The simulation stopped: {error}"
                return
            ends.append(time.monotonic())
            if len(ends) > 1:
                self.rate = (len(ends) - 1) / max(ends[-1] - ends[0], 1e-9)
            # A slow machine falls behind, and does not catch up later.
            due = max(due + frame_time, time.monotonic())
            self._stop.wait(max(due - time.monotonic(), 0.001))

    def _restart(self, message: str) -> None:
        self._again.clear()
        self.simulator.reset()
        self.grab.reset(self.simulator.hands)
        self.message = message

    def _step(self, frame_time: float) -> None:
        """Advance by one frame: controls, simulation, drawing."""
        simulator, node = self.simulator, self.grab.node
        before = simulator.grabbed
        at = simulator.target if node == before else simulator.positions[max(node, 0)]
        x = simulator.step(*self.grab.next(frame_time, simulator.hands, at))
        with self._server.atomic():
            self.body.move(x, simulator.hands)
            self._draw_splats(x, frame_time)
            if simulator.grabbed != before:
                self.body.mark(simulator.grabbed)

    def _draw_splats(self, x: np.ndarray, frame_time: float) -> None:
        """Move the splats, in as many frames as fit into 40 % of the time."""
        splats, every = self.body.splats, max(1, math.ceil(self._splat_seconds / (0.4 * frame_time)))
        if splats is not None and splats.handle.visible and self.simulator.frame % every == 0:
            start = time.monotonic()
            splats.move(x)
            self._splat_seconds = time.monotonic() - start


class Grab:
    """Grab of a node or a hand by one browser at a time; thread-safe. It checks all values that browsers send.

    `nodes`: number of nodes; `hands` [C, 3], m: controllers; `groups` [C]: their hand indices.
    """

    def __init__(self, nodes: int, hands: np.ndarray, groups: np.ndarray) -> None:
        self._lock, self._nodes, self._groups = threading.Lock(), nodes, groups
        self.reset(hands)

    def reset(self, hands: np.ndarray) -> None:
        """Release the grab; controllers are at [C, 3], m."""
        with self._lock:
            self.owner: int | None = None
            self.node, self._target, self._shift = -1, np.zeros(3, np.float32), np.zeros(3, np.float32)
            self._hand, self._from = -1, np.zeros(3)
            self.wanted = self._base = hands.copy()

    def take(self, client: int, kind: str, index: Any, position: Any, at: Any = None) -> bool:
        """Grab a node at `at` [3], m, or a hand, with the mouse at `position` [3], m. Returns False if it is not allowed."""
        point = _point(position)
        with self._lock:
            most = self._nodes if kind == "node" else len(self._groups)
            if self.owner is not None or point is None or not isinstance(index, int) or not 0 <= index < most:
                return False
            self.owner = client
            if kind == "node":
                self.node, self._shift = index, np.zeros(3, np.float32) if at is None else np.asarray(at, np.float32) - point
                self._target = point + self._shift
            else:
                self._hand, self._from, self._base = int(self._groups[index]), point, self.wanted.copy()
            return True

    def pull(self, client: int, position: Any) -> None:
        """Move the grab of a browser to the mouse position `position` [3], m."""
        point = _point(position)
        with self._lock:
            if self.owner != client or point is None:
                return
            self._target = point + self._shift
            if self._hand >= 0:
                self.wanted = self._base.copy()
                self.wanted[self._groups == self._hand] += point - self._from

    def release(self, client: int) -> None:
        """Release the grab of a browser, also when its page is closed. A hand keeps its position."""
        with self._lock:
            if self.owner == client:
                self.owner, self.node, self._hand = None, -1, -1

    def next(self, seconds: float, hands: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, int, np.ndarray]:
        """Controllers [C, 3], node and target [3] at the end of a frame, from controllers and target (`at`) at its start."""
        with self._lock:
            wanted, node, target = self.wanted, self.node, self._target
        reach = FASTEST_GRAB * seconds
        return hands + _limited(wanted - hands, reach), node, at + _limited((target - at)[None], reach)[0] if node >= 0 else target


def nearest_to_ray(points: np.ndarray, eye: Any, through: Any) -> int:
    """Index of the point [N, 3] nearest to the line from the eye [3] through a position [3], m."""
    eye, way = np.asarray(eye, float), np.asarray(through, float) - np.asarray(eye, float)
    way /= max(float(np.linalg.norm(way)), 1e-12)
    offset = points - eye
    return int(np.argmin(np.linalg.norm(offset - (offset @ way)[:, None] * way, axis=1)))


def _limited(moves: np.ndarray, reach: float) -> np.ndarray:
    """Moves [..., 3], m, shortened to at most `reach`."""
    length = np.linalg.norm(moves, axis=-1, keepdims=True)
    return np.asarray(moves * np.minimum(1.0, reach / np.maximum(length, 1e-12)), np.float32)


def _point(position: Any) -> np.ndarray | None:
    """Position sent by a browser, or None if it is invalid or outside the scene."""
    try:
        point = np.asarray(position, np.float32)
    except (TypeError, ValueError):
        return None
    return point if point.shape == (3,) and np.isfinite(point).all() and np.abs(point).max() < 100 else None
