"""The controls of live mode on the page."""

from __future__ import annotations

import threading
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from neuspring.core.errors import InputError
from neuspring.play.begin import Begin, Script, begin_at
from neuspring.play.controls import Controls
from neuspring.play.live import TOO_MUCH, Live
from neuspring.play.player import Player

if TYPE_CHECKING:
    import viser

DRAG = "Start, then drag a node or a hand (red) with the left button. Drag beside them to turn the view."
REPEAT = "Hands move as recorded, while you pull elsewhere. Switching begins again."
FROM = "Begins in the state of the prediction in this frame"


class LivePanel:
    """Starts and ends a live twin; `changed` is called when it has begun or ended."""

    def __init__(self, server: viser.ViserServer, player: Player, save_to: Path, changed: Callable[[], None]) -> None:
        self.live: Live | None = None
        self._server, self._player, self._save_to, self._changed = server, player, save_to, changed
        self._lock = threading.RLock()
        names = [run.name for run in player.found.runs if run.twin_path is not None]
        gui = server.gui
        if not names:
            gui.add_markdown("No run here has a twin, so there is nothing to pull.")
            return
        self.twin = gui.add_dropdown("Twin", tuple(names))
        self.frame = gui.add_slider("From frame", 0, player.clock.count - 1, 1, 0, hint=FROM)
        self.repeat = gui.add_checkbox("Hands repeat the recording", False, hint=REPEAT)
        gui.add_html(f"<div style='margin:0 .8em;font-size:.8em'>{DRAG}</div>")
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
        server.on_client_disconnect(lambda client: self._left(client.client_id))

    def start(self, name: str, played: Controls | None = None) -> None:
        """Begin with a run's twin, or show what was recorded of it."""
        with self._lock:
            self.stop()
            try:
                run = self._player.run(name)
                begin = Begin(played.start_frame, played.start, Script()) if played else self._begin(name)
                self._player.hide(True, float(self.most.value))
                self.live = Live(self._server, self._player, run, begin, played)
            except InputError as error:
                self._player.hide(False)
                self.text.content = f"<div style='margin:0 .8em'>{escape(str(error))}</div>"
                return
            self._limit()
            self.switch.label, self.again.disabled, self.save.disabled = "Stop", False, played is not None

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
        live = self.live
        if live is not None:
            self.text.content = live.status()

    def _begin(self, name: str) -> Begin:
        run, seen = self._player.run(name), self._player.found.observations
        return begin_at(run, seen, int(self.frame.value), bool(self.repeat.value))

    def _reset(self) -> None:
        if self.live is not None:
            self.live.reset()

    def _left(self, client: int) -> None:
        """A closed page lets go."""
        if self.live is not None:
            self.live.hold.release(client)

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
