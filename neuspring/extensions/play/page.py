"""The control panel: live twin, time, runs, switches and legend."""

from __future__ import annotations

import math
import threading
import time
from html import escape
from typing import TYPE_CHECKING, Any

from neuspring.core.errors import InputError
from neuspring.extensions.play.live import Live
from neuspring.extensions.play.player import MOST_RUNS_SHOWN, Player
from neuspring.report.shown import Found

if TYPE_CHECKING:
    import viser

VIEW_ANGLE = math.radians(45)
"""Vertical angle of view, radians."""
PHONE, PANEL_SHARE = 576, 0.45
"""In windows narrower than this, CSS pixels, the panel covers this fraction at the bottom."""
FIT = (
    f"<style>@media (max-width: {PHONE}px) {{ [style*='max-height: 60%'] {{ width: 100% !important; "
    f"max-height: {PANEL_SHARE:.0%} !important }} [style*='width: 20em'] {{ width: 100% !important }} }}</style>"
)
"""Style that widens viser's panel to the window on a phone."""
SWITCHES = {"splats": "Splats", "springs": "Springs, nodes, hands (red)", "points": "Observed points (green)"}


class Page:
    """The controls, shared by all browsers with the page open."""

    def __init__(self, server: viser.ViserServer, found: Found) -> None:
        self.server, self.found, self.player = server, found, Player(server.scene, found)
        self.live: Live | None = None
        self._stop, self._moved, self._lock = threading.Event(), False, threading.RLock()
        scenario, gui = found.observations.scenario, server.gui
        server.scene.set_up_direction(scenario.up)
        # Next to the scene instead of over it.
        gui.main_panel.dock_right()
        camera = server.initial_camera
        camera.fov = VIEW_ANGLE
        camera.up, camera.look_at, camera.position = self.player.view(VIEW_ANGLE)
        server.on_client_connect(self._connected)
        server.on_client_disconnect(self._left)
        gui.add_html(FIT)
        gui.add_markdown(f"**{scenario.name}** ({scenario.category}): {scenario.frame_count} frames, {scenario.frame_rate:g} fps")
        with gui.add_folder("Live"):
            self._add_live()
        with gui.add_folder("Recording"):
            self._add_time()
        with gui.add_folder("Show"):
            self.parts: dict[str, Any] = {
                name: gui.add_checkbox(title, getattr(self.player, name), disabled=name == "splats" and not self.player.splats)
                for name, title in SWITCHES.items()
            }
            self.legend = gui.add_html("")
            self.boxes: dict[str, Any] = {
                run.name: gui.add_checkbox(run.name, run.name in self.player.runs, hint="; ".join(run.notes) or None)
                for run in found.runs
            }
            self.notes = gui.add_html("")
        for handle in (*self.boxes.values(), *self.parts.values()):
            handle.on_update(lambda _: self._changed())
        self._changed()
        self._thread = threading.Thread(target=self._tick, name="clock", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the clock and a live twin."""
        self._stop.set()
        self._thread.join(5)
        self.end()

    def _add_time(self) -> None:
        gui, clock = self.server.gui, self.player.clock
        self.bar = gui.add_html(clock.bar())
        last = clock.count - 1
        marks = ((0, "0"), (min(clock.border, last), "future"), (last, str(last)))
        self.slider: Any = gui.add_slider("Frame", 0, last, 1, 0, marks=marks)
        self.play = gui.add_button("Play")
        # Reacts only to users, because the clock moves the slider too.
        self.slider.on_update(lambda event: self.show(int(self.slider.value)) if event.client_id is not None else None)
        self.play.on_click(lambda _: self.toggle())
        steps = {"arrowright": lambda: self.show(clock.frame + 1), "arrowleft": lambda: self.show(clock.frame - 1)}
        for key, action in {"space": self.toggle, **steps}.items():
            gui.add_command(f"Time: {key}", hotkey=key).on_trigger(lambda _, action=action: action())  # type: ignore[misc,arg-type]

    def _add_live(self) -> None:
        gui, names = self.server.gui, [run.name for run in self.found.runs if "twin" in run.paths]
        self.text = gui.add_html("")
        if not names:
            gui.add_markdown("No run has a twin to pull.")
            return
        gui.add_markdown("Press Start, then drag a node or a hand (red) with the left button. Drag elsewhere to rotate the view.")
        self.twin = gui.add_dropdown("Twin", tuple(names))
        self.switch, self.again = gui.add_button("Start"), gui.add_button("Reset", disabled=True)
        self.switch.on_click(lambda _: self.end() if self.live else self.begin(self.twin.value))
        self.again.on_click(lambda _: self.live.reset() if self.live else None)
        self.twin.on_update(lambda _: self.begin(self.twin.value) if self.live else None)

    def begin(self, name: str) -> None:
        """Simulate a run's twin in place of the recording, and show its springs."""
        with self._lock:
            self.end()
            try:
                self.player.hide(True)
                self.live = Live(self.server, self.player, self.player.run(name))
            except InputError as error:
                self.player.hide(False)
                self.text.content = f"<div style='margin:0 .8em'>{escape(str(error))}</div>"
                return
            self.switch.label, self.again.disabled = "Back to the recording", False
            self._frame_all()

    def end(self) -> None:
        """End a live twin, and return to the recording."""
        with self._lock:
            if self.live is not None:
                self.live.close()
                self.live = None
                self.player.hide(False)
                self.switch.label, self.again.disabled, self.text.content = "Start", True, ""
                self._frame_all()

    def toggle(self) -> None:
        """Play or pause the recording; ends a live twin."""
        self.end()
        with self.player.lock:
            self.player.clock.playing = not self.player.clock.playing
        self.play.label = "Pause" if self.player.clock.playing else "Play"

    def show(self, frame: int) -> None:
        """Show a frame and pause; ends a live twin."""
        self.end()
        with self.player.lock:
            self.player.clock.playing, self._moved = False, True
            self.player.clock.show(frame)

    def _changed(self) -> None:
        """Apply the switches."""
        player = self.player
        with player.lock:
            for name, box in self.parts.items():
                setattr(player, name, bool(box.value))
            player.runs = [name for name, box in self.boxes.items() if box.value]
            player.apply()
            if self.live is not None:
                player.dress(self.live.body, self.live.run, springs=True)
            self.legend.content = player.scale.legend() if player.scale and player.springs else ""
            notes = [f"{name}: {note}" for name, note in player.notes.items() if note and name in player.runs]
            if len(player.runs) > MOST_RUNS_SHOWN:
                notes.append(f"At most {MOST_RUNS_SHOWN} runs are shown; deselect some to see others")
            rows = "<br>".join(escape(note[:400]) for note in [*self.found.notes, *notes])
            self.notes.content = f"<div style='margin:0 .8em;font-size:.8em'>{rows}</div>"

    def _connected(self, client: viser.ClientHandle) -> None:
        self.player.watched.set()
        self._frame(client)
        wide, end = client.camera.image_width, time.monotonic() + 5
        # The panel changes the width of the scene a moment later.
        while client.camera.image_width == wide and time.monotonic() < end and not self._stop.wait(0.1):
            pass
        self._frame(client)

    def _left(self, client: viser.ClientHandle) -> None:
        """Release the grab of a closed page; pause while no browser has the page open."""
        if self.live is not None:
            self.live.grab.release(client.client_id)
        if not self.server.get_clients():
            self.player.watched.clear()

    def _frame_all(self) -> None:
        for client in self.server.get_clients().values() if len(self.player.runs) > 1 else ():
            self._frame(client)

    def _frame(self, client: viser.ClientHandle) -> None:
        """Fit all shown runs into the window of a browser."""
        camera = client.camera
        wide, high = max(camera.image_width, 1), max(camera.image_height, 1)
        covered, count = (PANEL_SHARE if wide < PHONE else 0.0), (1 if self.live else MOST_RUNS_SHOWN)
        # Setting the position changes look_at, so look_at comes last.
        _, look_at, camera.position = self.player.view(camera.fov, wide / high, covered, count)
        camera.look_at = look_at

    def _tick(self) -> None:
        """Advance time and draw changes, at most 30 times per second."""
        last = told = time.monotonic()
        while not self._stop.wait(1 / 30):
            now, player = time.monotonic(), self.player
            with player.lock:
                changed = (player.watched.is_set() and player.clock.advance(now - last)) or self._moved
                self._moved, last = False, now
                if changed:
                    with self.server.atomic():
                        player.draw()
                        self.slider.value = player.clock.frame
                        self.bar.content = player.clock.bar()
                playing = player.clock.playing
            if now - told > 0.25 and (live := self.live):
                told, self.text.content = now, live.status()
            if self.play.label != (wanted := "Pause" if playing else "Play"):
                self.play.label = wanted
