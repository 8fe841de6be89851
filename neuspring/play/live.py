"""A twin in your hands: it is simulated in real time while its nodes and hands are pulled with the mouse."""

from __future__ import annotations

import threading
import time
from collections import deque
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neuspring.core.errors import InputError
from neuspring.play.body import Body
from neuspring.play.controls import MOST_FRAMES, Controls, digest_motion
from neuspring.play.hold import Hold, nearest_to_ray
from neuspring.play.player import Player
from neuspring.play.results import Run
from neuspring.play.simulator import Simulator, hands_of
from neuspring.twin.rollout import Diverged

if TYPE_CHECKING:
    import viser

WINDOW = 30
"""Frames that the frame rate is an average of."""
TOO_MUCH = 0.3
"""Strain from which springs are red at the beginning."""


class Live:
    """One twin, simulated in a thread of its own, one frame of the twin after another."""

    def __init__(self, server: viser.ViserServer, player: Player, run: Run, script: Controls | None = None) -> None:
        twin = run.twin
        if twin is None:
            raise InputError(run.folder, "a run with a twin is required", "none", "Choose a method that makes a twin.")
        self.run, self.script, self._server, self._player = run, script, server, player
        self.simulator = Simulator(twin)
        self.hold = Hold(len(twin.topology.nodes), twin.topology.controllers, hands_of(twin.topology.controllers))
        self.most, self.message = TOO_MUCH, ""
        self.strain, self.over = 0.0, 0
        self.rate = self.factor = 0.0
        self._log: list[tuple[np.ndarray, int, np.ndarray]] | None = [] if script is None else None
        self._seen: list[np.ndarray] | None = [self.simulator.positions]
        self._lock, self._again, self._stop = threading.Lock(), threading.Event(), threading.Event()
        self.body = Body(server.scene, f"live {run.name}", twin, twin.topology.nodes, twin.topology.controllers)
        if script is None:
            self._listen()
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the simulation, and take the twin out of the scene."""
        self._stop.set()
        self._thread.join(10)
        self.body.remove()

    def reset(self) -> None:
        """Back to frame 0 before the next step; what was recorded is forgotten."""
        self._again.set()

    def recorded(self) -> Controls:
        """What was done since the last reset. Raises InputError where that is nothing, or too long."""
        with self._lock:
            log, seen = list(self._log or ()), list(self._seen or ())
        if not log:
            raise InputError("recording", "at least one frame is required", 0, "Reset, and pull again.")
        hands, grabbed, target = (np.stack([np.asarray(row[column]) for row in log]) for column in range(3))
        return Controls(
            hands=hands,
            grabbed=grabbed.astype(np.int32),
            target=target,
            scenario=self._player.found.observations.scenario.name,
            method=self.run.method,
            seed=self.run.seed,
            twin_digest=self.run.twin_digest,
            motion_digest=digest_motion(np.stack(seen)) if len(seen) == len(log) + 1 else "",
        )

    def status(self) -> str:
        """Frame rate, strain and what is held, as HTML."""
        simulator, node = self.simulator, self.simulator.grabbed
        wanted = 1 / simulator.twin.simulation.frame_time
        held = "nothing is held"
        if node >= 0:
            held = f"node {node} is held, k = {simulator.grab_stiffness(node)[0]:.3g} N/m"
        color = "#d94801" if self.over else "inherit"
        lines = [
            f"<b>{self.rate:.1f} frames/s</b> of {wanted:.0f}; real-time factor <b>{self.factor:.2f}</b>",
            f"frame {simulator.frame}, {simulator.frame / wanted:.1f} s of the twin's time; {held}",
            f"<span style='color:{color}'>largest strain {self.strain:.2f}; red above {self.most:.2f}: {self.over} springs</span>",
            escape(self.message),
        ]
        return f"<div style='margin:0 .8em;font-size:.8em'>{'<br>'.join(line for line in lines if line)}</div>"

    def _listen(self) -> None:
        """Take drags. Asynchronous functions keep the order of a drag's events."""

        def listener(kind: str) -> Any:
            async def dragged(event: Any) -> None:
                if event.phase == "start":
                    self._take(event, kind)
                if event.phase == "end":
                    self.hold.release(event.client_id)
                else:
                    self.hold.pull(event.client_id, event.end_position)

            return dragged

        self.body.handles().on_drag("left")(listener("node"))
        self.body.nodes.on_drag("left")(listener("node"))
        self.body.hands.on_drag("left")(listener("hand"))

    def _take(self, event: Any, kind: str) -> None:
        """Grab a hand, or the node nearest to where the mouse points."""
        index, x = event.instance_index, self.simulator.positions
        if kind == "node":
            index = nearest_to_ray(x, event.client.camera.position, event.start_position)
        self.hold.take(event.client_id, kind, index, event.start_position, x[index] if kind == "node" else None)

    def _run(self) -> None:
        frame_time = self.simulator.twin.simulation.frame_time
        ends: deque[float] = deque(maxlen=WINDOW)
        due = time.monotonic()
        while not self._stop.is_set():
            if self._again.is_set():
                self._begin()
            try:
                self._step(frame_time)
            except Diverged as end:
                self._begin()
                self.message = f"{end}; it began again"
            except Exception as error:
                self.message = f"stopped: {error}"
                return
            ends.append(time.monotonic())
            if len(ends) > 1:
                self.rate = (len(ends) - 1) / max(ends[-1] - ends[0], 1e-9)
                self.factor = self.rate * frame_time
            # A slow machine falls behind, and does not hurry later.
            due = max(due + frame_time, time.monotonic())
            self._stop.wait(max(due - time.monotonic(), 0.001))

    def _begin(self) -> None:
        self._again.clear()
        self.simulator.reset()
        self.hold.reset()
        with self._lock:
            self._log, self._seen = ([] if self.script is None else None), [self.simulator.positions]
        self.message = ""

    def _step(self, frame_time: float) -> None:
        simulator, script = self.simulator, self.script
        before = simulator.grabbed
        if script is not None:
            if simulator.frame >= len(script.grabbed):
                return
            row = simulator.frame
            controls = (script.hands[row], int(script.grabbed[row]), script.target[row])
        else:
            node = self.hold.node
            at = simulator.target if node == simulator.grabbed else simulator.positions[max(node, 0)]
            controls = self.hold.next(frame_time, simulator.hands, at)
        x = simulator.step(*controls)
        self._keep(controls, x)
        with self._server.atomic():
            look = self._player.look
            quantity = look.quantity
            self.body.show(nodes=look.nodes, springs=look.springs, hands=look.hands)
            strain = self.body.move(x, simulator.hands, quantity, self._player.scale, self.most)
            if simulator.grabbed != before:
                self.body.mark(simulator.grabbed if simulator.grabbed >= 0 else None)
        self.strain, self.over = float(strain.max(initial=0.0)), int((strain > self.most).sum())

    def _keep(self, controls: tuple[np.ndarray, int, np.ndarray], x: np.ndarray) -> None:
        """Record a frame, up to the most; compare the end of a replay with what was recorded."""
        with self._lock:
            if self._seen is not None:
                self._seen.append(x.copy())
            if self._log is not None:
                self._log.append(controls)
                if len(self._log) > MOST_FRAMES:
                    # Memory ends here. What came before cannot be played without its begin, so all of it goes.
                    self._log, self._seen = None, None
                    self.message = f"the recording ended after {MOST_FRAMES} frames; reset to begin another"
            if self.script is not None and self._seen is not None and self.simulator.frame == len(self.script.grabbed):
                same = digest_motion(np.stack(self._seen)) == self.script.motion_digest
                self.message = "the same motion as recorded, bit for bit" if same else "not the motion that was recorded"


class LivePanel:
    """The controls of live mode on the page."""

    def __init__(self, server: viser.ViserServer, player: Player, save_to: Path) -> None:
        self.live: Live | None = None
        self._server, self._player, self._save_to = server, player, save_to
        self._lock = threading.RLock()
        names = [run.name for run in player.found.runs if run.twin_path is not None]
        gui = server.gui
        with gui.add_folder("Live"):
            if not names:
                gui.add_markdown("No run here has a twin, so there is nothing to pull.")
                return
            self.twin = gui.add_dropdown("Twin", tuple(names))
            self.switch = gui.add_button("Start", hint="Drag a node or a hand (red) with the left button; drag beside them to turn")
            self.again = gui.add_button("Reset", disabled=True)
            self.save = gui.add_button("Save recording", disabled=True, hint="What was done since the last reset")
            self.most = gui.add_slider("Red above", 0.05, 2.0, 0.05, TOO_MUCH, hint="strain l / l0 − 1")
            self.text = gui.add_html("")
        self.switch.on_click(lambda _: self.stop() if self.live else self.start(self.twin.value))
        self.again.on_click(lambda _: self.live and self.live.reset())
        self.save.on_click(lambda _: self._save())
        self.most.on_update(lambda _: self._limit())
        gui.add_command("Reset the live twin", hotkey="R").on_trigger(lambda _: self.live and self.live.reset())
        server.on_client_disconnect(lambda client: self.live and self.live.hold.release(client.client_id))

    def start(self, name: str, script: Controls | None = None) -> None:
        """Begin with a run's twin, or show what was recorded of it."""
        with self._lock:
            self.stop()
            try:
                run = self._player.run(name)
                self._player.hide(True)
                self.live = Live(self._server, self._player, run, script)
            except InputError as error:
                self._player.hide(False)
                self.text.content = f"<div style='margin:0 .8em'>{escape(str(error))}</div>"
                return
            self._limit()
            self.switch.label, self.again.disabled, self.save.disabled = "Stop", False, script is not None

    def stop(self) -> None:
        """Back to the recording."""
        with self._lock:
            if self.live is not None:
                self.live.close()
                self.live = None
                self._player.hide(False)
                self.switch.label, self.again.disabled, self.save.disabled = "Start", True, True
                self.text.content = ""

    def refresh(self) -> None:
        """Show the state; called a few times per second."""
        live = self.live
        if live is not None:
            self.text.content = live.status()

    def _limit(self) -> None:
        if self.live:
            self.live.most = float(self.most.value)

    def _save(self) -> None:
        """Write what was recorded beside earlier recordings."""
        live = self.live
        if live is None:
            return
        try:
            controls = live.recorded()
            stem = f"controls_{controls.scenario}_{controls.method}_{controls.seed}"
            path = next(p for i in range(10_000) if not (p := self._save_to / f"{stem}_{i}.npz").exists())
            controls.save(path)
            live.message = f"saved {len(controls.grabbed)} frames: {path}"
        except (InputError, StopIteration) as error:
            live.message = f"not saved: {error}"
