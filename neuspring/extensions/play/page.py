"""The page beside the scene: time, runs, what is shown, the legend, and a twin in your hands."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.core.errors import InputError
from neuspring.extensions.play import layers
from neuspring.extensions.play.colors import QUANTITIES
from neuspring.extensions.play.controls import Controls
from neuspring.extensions.play.live import TOO_MUCH, Live
from neuspring.extensions.play.player import MOST_RUNS_SHOWN, SPEEDS, Player
from neuspring.extensions.play.simulator import StartState, start_state
from neuspring.report.shown import Found

if TYPE_CHECKING:
    import viser

RATE = 30.0
"""Most drawings per second."""
PART_TITLES = {
    "nodes": "Nodes",
    "springs": "Springs",
    "hands": "Hands",
    "splats": "Splats",
    "points": "Observed points",
    "tracks": "Tracks",
    "cameras": "Cameras",
    "images": "Camera images",
}
DRAG = "Start, then drag a node or a hand (red) with the left button. Drag beside them to turn the view."
REPEAT = "Hands move as recorded, while you pull elsewhere. Switching begins again."
FROM = "Begins in the state of the prediction in this frame"
KEY_HINTS = "Keys: space plays, arrows left and right step, home and end jump, R resets a live twin, Escape leaves it."
BACK = "Back to the recording"
VIEW_ANGLE = math.radians(45)
"""Vertical angle of view."""
PHONE, PANEL_SHARE = 576, 0.45
"""A window narrower than this, CSS pixels, has its panel below, over this part of it."""
FIT = (
    f"<style>@media (max-width: {PHONE}px) {{ [style*='max-height: 60%'] {{ width: 100% !important; "
    f"max-height: {PANEL_SHARE:.0%} !important }} [style*='width: 20em'] {{ width: 100% !important }} }}</style>"
)
"""viser's panel on a phone is as wide as the window."""
SMALL_STYLE = "margin:0 .8em;font-size:.8em"
OBSERVED_MARKS = {
    "observed points": layers.SEEN_COLOR,
    "annotated tracks": layers.TRACK_COLOR,
    "where the run predicts them": layers.PREDICTED_COLOR,
    "hands": layers.HAND_COLOR,
    "the node that is held": layers.GRABBED_COLOR,
    "cameras": layers.CAMERA_COLOR,
    "parts of the body that nobody saw in frame 0": layers.NOT_SEEN_COLOR,
}
"""Colors of what is not a spring."""


class Page:
    """The controls of a recording, shared by all browsers that have it open."""

    def __init__(self, server: viser.ViserServer, found: Found, save_to: Path = Path()) -> None:
        self.server, self.found, self.player = server, found, Player(server.scene, found)
        self._stop, self._moved = threading.Event(), False
        self._alive, self._before = False, (self.player.display.quantity, self.player.display.hands)
        self.boxes: dict[str, Any] = {}
        self.parts: dict[str, Any] = {}
        scenario, gui = found.observations.scenario, server.gui
        server.scene.set_up_direction(scenario.up)
        # Beside the scene, not over it.
        gui.main_panel.dock_right()
        # The first view: all shown runs, across the row in which they stand.
        camera = server.initial_camera
        camera.fov = VIEW_ANGLE
        camera.up, camera.look_at, camera.position = self.player.view(VIEW_ANGLE)
        server.on_client_connect(self._connected)
        server.on_client_disconnect(lambda client: self._left())
        gui.add_html(FIT)
        gui.add_markdown(
            f"**{scenario.name}** ({scenario.category}): {scenario.frame_count} frames at {scenario.frame_rate:g} per second. "
            "To pull the twin: *Live*, *Start*, then drag it. Forces are shown as if each node, or each meter of a cable, weighed "
            "1 kg; `neuspring export --mass` scales them to the object."
        )
        self.quantity: Any = gui.add_dropdown("Springs by", QUANTITIES, initial_value=self._before[0])
        self.legend = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Recording"):
            self._add_time()
            self._add_runs()
        with tabs.add_tab("Show"):
            self._add_parts()
        with tabs.add_tab("Live"):
            self.panel = LivePanel(server, self.player, save_to, self._lived)
        for handle in (self.quantity, self.gap, *self.boxes.values(), *self.parts.values()):
            handle.on_update(lambda _: self._changed())
        self._changed()
        self._add_keys()
        self._thread = threading.Thread(target=self._tick, name="clock", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the clock."""
        self._stop.set()
        self._thread.join(5)
        self.panel.stop()

    def _add_time(self) -> None:
        gui, clock = self.server.gui, self.player.clock
        with gui.add_folder("Time"):
            self.bar, self.errors = gui.add_html(clock.bar()), gui.add_html("")
            last = clock.count - 1
            marks = ((0, "0"), (min(clock.border, last), "future"), (last, str(last)))
            self.slider: Any = gui.add_slider("Frame", 0, last, 1, 0, marks=marks)
            self.play = gui.add_button("Play")
            speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 ×")
            loop = gui.add_checkbox("Loop", clock.loop)
        self.slider.on_update(lambda event: self._scrubbed(event))
        self.play.on_click(lambda _: self.toggle())
        speed.on_update(lambda _: setattr(clock, "speed", SPEEDS[speed.value]))
        loop.on_update(lambda _: setattr(clock, "loop", bool(loop.value)))

    def _add_runs(self) -> None:
        gui, display = self.server.gui, self.player.display
        with gui.add_folder("Runs", expand_by_default=len(self.found.runs) <= 12):
            for run in self.found.runs:
                self.boxes[run.name] = gui.add_checkbox(run.name, run.name in display.runs, hint="; ".join(run.notes) or None)
            self.gap: Any = gui.add_slider("Side by side", 0.0, 3.0, 0.1, display.gap, hint="0: all in one place")
            self.notes = gui.add_html("")

    def _add_parts(self) -> None:
        gui, found, absent = self.server.gui, self.found, dict[str, str]()
        if found.capture is None:
            absent["cameras"] = absent["images"] = "no capture in the scenario's folder"
        if not found.observations.tracks.size:
            absent["tracks"] = "no tracks were annotated"
        if not any("splats" in run.paths for run in found.runs):
            absent["splats"] = "no run here has splats"
        for name, title in PART_TITLES.items():
            hint, wanted = absent.get(name), getattr(self.player.display, name)
            self.parts[name] = gui.add_checkbox(title, wanted and not hint, disabled=bool(hint), hint=hint)
        marks = "".join(
            f"<div><span style='color:rgb{color}'>&#9679;</span> {text}</div>" for text, color in OBSERVED_MARKS.items()
        )
        gui.add_html(f"<div style='{SMALL_STYLE};margin-top:.6em'>{marks}</div>")

    def _add_keys(self) -> None:
        gui, clock = self.server.gui, self.player.clock
        gui.add_html(f"<div style='{SMALL_STYLE}'>{KEY_HINTS}</div>")
        for label, key, action in (
            ("Play or pause", "space", self.toggle),
            ("Next frame", "arrowright", lambda: self.show(clock.frame + 1)),
            ("Previous frame", "arrowleft", lambda: self.show(clock.frame - 1)),
            ("First frame", "home", lambda: self.show(0)),
            ("Last frame", "end", lambda: self.show(clock.count - 1)),
        ):
            gui.add_command(label, hotkey=key).on_trigger(lambda _, action=action: action())  # type: ignore[misc,arg-type]

    def toggle(self) -> None:
        """Play, or pause; a live twin ends."""
        self.panel.stop()
        clock = self.player.clock
        with self.player.lock:
            if not clock.playing and clock.frame == clock.count - 1:
                clock.show(0)
            clock.playing = not clock.playing
        self.play.label = "Pause" if clock.playing else "Play"

    def show(self, frame: int) -> None:
        """Go to a frame, and stay there; a live twin ends."""
        self.panel.stop()
        with self.player.lock:
            self.player.clock.playing = False
            self.player.clock.show(frame)
            self._moved = True

    def _scrubbed(self, event: Any) -> None:
        # Only what a person does: the clock moves the slider too.
        if event.client_id is not None:
            self.show(int(self.slider.value))

    def _changed(self) -> None:
        """Take over what was switched."""
        display = self.player.display
        with self.player.lock:
            for name, box in self.parts.items():
                setattr(display, name, bool(box.value))
            display.quantity = self.quantity.value
            display.gap = float(self.gap.value)
            display.runs = [name for name, box in self.boxes.items() if box.value]
            self.player.apply()
            self.legend.content = self.player.legend()
            notes = [f"{name}: {note}" for name, note in self.player.notes.items() if note and name in display.runs]
            if len(display.runs) > MOST_RUNS_SHOWN:
                notes.append(f"{MOST_RUNS_SHOWN} runs are shown at once; take some away to see others")
            rows = "<br>".join(escape(note[:400]) for note in [*self.found.notes, *notes])
            self.notes.content = f"<div style='{SMALL_STYLE}'>{rows}</div>"
        self._update_error_text()

    def _lived(self) -> None:
        """A live twin has begun or ended: it is shown by strain, with hands to be pulled, unless something else was chosen."""
        live = self.panel.live is not None
        if live != self._alive:
            self._alive, hands = live, self.parts["hands"]
            if live:
                self._before = self.quantity.value, hands.value
                self.quantity.value, hands.value = "strain", True
            else:
                self.quantity.value = self._before[0] if self.quantity.value == "strain" else self.quantity.value
                hands.value = self._before[1]
            for client in self.server.get_clients().values() if len(self.player.display.runs) > 1 else ():
                self._frame(client)
        self._changed()

    def _connected(self, client: viser.ClientHandle) -> None:
        self.player.watched.set()
        self._frame(client)
        wide, end = client.camera.image_width, time.monotonic() + 5
        # The panel takes its place a moment later.
        while client.camera.image_width == wide and time.monotonic() < end and not self._stop.wait(0.1):
            pass
        if client.camera.image_width != wide:
            self._frame(client)

    def _left(self) -> None:
        """Time stands still while nobody has the page open."""
        if not self.server.get_clients():
            self.player.watched.clear()

    def _frame(self, client: viser.ClientHandle) -> None:
        """Let a browser see all that is shown, whatever the shape of its window."""
        camera = client.camera
        wide, high = max(camera.image_width, 1), max(camera.image_height, 1)
        covered, count = (PANEL_SHARE if wide < PHONE else 0.0), (1 if self._alive else MOST_RUNS_SHOWN)
        # A new place moves what is looked at, so that this comes last.
        _, look_at, camera.position = self.player.view(camera.fov, wide / high, covered, count)
        camera.look_at = look_at

    def _update_error_text(self) -> None:
        found = self.player.errors()
        what = "track error in this frame" if self.player.clock.frame else "in frame 0, distance of tracked points from their nodes"
        self.errors.content = f"<div style='{SMALL_STYLE}'>{what}: {escape(found)}</div>" if found else ""

    def _tick(self) -> None:
        """Let time pass, and draw what has changed."""
        last = told = time.monotonic()
        while not self._stop.wait(1 / RATE):
            now = time.monotonic()
            with self.player.lock:
                changed = (self.player.watched.is_set() and self.player.clock.advance(now - last)) or self._moved
                self._moved, last = False, now
                if changed:
                    with self.server.atomic():
                        self.player.draw()
                        self.slider.value = self.player.clock.frame
                        self.bar.content = self.player.clock.bar()
                playing = self.player.clock.playing
            if now - told > 0.25:
                told = now
                self.panel.refresh()
                self._update_error_text()
            if self.play.label != (wanted := "Pause" if playing else "Play"):
                self.play.label = wanted


class LivePanel:
    """Starts and ends a live twin; `changed` is called when it has begun or ended."""

    def __init__(self, server: viser.ViserServer, player: Player, save_to: Path, changed: Callable[[], None]) -> None:
        self.live: Live | None = None
        self._server, self._player, self._save_to, self._changed = server, player, save_to, changed
        self._lock = threading.RLock()
        names = [run.name for run in player.found.runs if "twin" in run.paths]
        gui = server.gui
        if not names:
            gui.add_markdown("No run here has a twin, so there is nothing to pull.")
            return
        self.twin = gui.add_dropdown("Twin", tuple(names))
        self.frame = gui.add_slider("From frame", 0, player.clock.count - 1, 1, 0, hint=FROM)
        self.repeat = gui.add_checkbox("Hands repeat the recording", False, hint=REPEAT)
        gui.add_html(f"<div style='{SMALL_STYLE}'>{DRAG}</div>")
        self.switch = gui.add_button("Start")
        self.again = gui.add_button("Reset", disabled=True)
        self.save = gui.add_button("Save recording", disabled=True, hint="What was done since the last reset")
        self.most = gui.add_slider("Red above", 0.05, 2.0, 0.05, TOO_MUCH, hint="strain l / l0 − 1")
        self.text = gui.add_html("")
        self.switch.on_click(lambda _: self.stop() if self.live else self.start(self.twin.value))
        self.again.on_click(lambda _: self._reset())
        self.save.on_click(lambda _: self._save())
        self.most.on_update(lambda _: self._limit())
        for choice in (self.twin, self.frame, self.repeat):
            choice.on_update(lambda _: self._chosen())
        gui.add_command("Reset the live twin", hotkey="R").on_trigger(lambda _: self._reset())
        gui.add_command(BACK, hotkey="escape").on_trigger(lambda _: self.stop())
        server.on_client_disconnect(lambda client: self._disconnected(client.client_id))

    def start(self, name: str, played: Controls | None = None) -> None:
        """Begin with a run's twin, or show what was recorded of it."""
        with self._lock:
            self.stop()
            try:
                run = self._player.run(name)
                seen, frame = self._player.found.observations, int(self.frame.value)
                begin = StartState(played.start_frame, played.start) if played else start_state(run, seen, frame, self.repeat.value)
                self._player.hide(True, float(self.most.value))
                self.live = Live(self._server, self._player, run, begin, played)
            except InputError as error:
                self._player.hide(False)
                self.text.content = f"<div style='margin:0 .8em'>{escape(str(error))}</div>"
                return
            self._limit()
            self.switch.label, self.again.disabled, self.save.disabled = BACK, False, played is not None

    def stop(self) -> None:
        """Back to the recording."""
        with self._lock:
            if self.live is not None:
                self.live.close()
                self.live = None
                self._player.hide(False)
                self.switch.label, self.again.disabled, self.save.disabled = "Start", True, True
                self.text.content = ""
                self._changed()

    def refresh(self) -> None:
        """Show the state; called a few times per second."""
        if live := self.live:
            self.text.content = live.status()

    def _reset(self) -> None:
        if self.live is not None:
            self.live.reset()

    def _disconnected(self, client: int) -> None:
        """A closed page lets go."""
        if self.live is not None:
            self.live.grab.release(client)

    def _chosen(self) -> None:
        """Another start is another live twin."""
        with self._lock:
            if self.live is not None and self.live.played is None:
                self.start(self.twin.value)

    def _limit(self) -> None:
        if self.live:
            self.live.most = self._player.limit = float(self.most.value)
            self._changed()

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
        except (InputError, OSError, StopIteration) as error:
            live.message = f"not saved: {error}"
