"""Chain of commands from a video to its twin: each is a process with shown and logged output, skipped if it is done."""

from __future__ import annotations

import json
import math
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from neuspring.config.parse import read_yaml
from neuspring.core.errors import InputError
from neuspring.core.files import load_json, write_text
from neuspring.core.run_folder import RunFolder
from neuspring.core.text import duration
from neuspring.data.capture import CAPTURE, read_description
from neuspring.experiments.local import workflow_command, workflow_folder
from neuspring.extensions.own_video.options import Wish

StepRun = Callable[[list[str], Path], int]
TWIN_STEPS = ("capture", "masks", "check", "twin")
STEPS_DONE = "steps.json"
"""Step -> command of each finished step; `window`: the chosen frames; `options`: options of finished steps."""
STEP_OPTIONS = {
    "capture": ("film", "category", "mass", "frames", "intake"),
    "masks": ("masks", "hands", "marks"),
    "twin": ("effort", "method"),
}
"""Step -> options of `neuspring twin` that determine its result."""
PROPOSED = re.compile(r"--frames (\d+-\d+)")
"""The longest constant grasp, which `check-data` proposes first."""
WINDOW = re.compile(r"all|\d+-\d+")
MOVIE_ENDINGS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
LOOK_FOR_MASKS, GRACE = 0.5, 2.0
"""s: interval of the checks for saved masks, and delay before the page is stopped."""
JOINED: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "encoding": "utf-8", "errors": "replace"}
BESIDE = "static"
"""Baseline without learning, for comparison with the twin's errors."""


class StepFailed(Exception):
    """A step failed; the argument is its exit status."""


class TwinChain:
    """The steps for one set of options. Raises InputError for invalid options before anything runs or is written."""

    def __init__(self, wish: Wish) -> None:
        film = wish.film
        if not film.exists():
            raise InputError(film, "must be a folder of color and depth, a recording, a video or a capture", "no such path")
        name = re.sub(r"[^A-Za-z0-9_.-]+", "_", film.resolve().stem if film.is_file() else film.resolve().name).strip("._-")
        self.folder = (wish.output or Path("twins") / name).resolve()
        record = self.folder / STEPS_DONE
        self.done: dict[str, Any] = load_json(record) if record.is_file() else {}
        masks, hands = (tuple(map(Path.resolve, paths)) for paths in (wish.masks, wish.hands))
        wish = replace(wish, film=film.resolve(), masks=masks, hands=hands, marks=wish.marks and wish.marks.resolve())
        self.wish = wish = self._with_earlier_options(wish)
        if wish.mass is not None and not 0 < wish.mass < math.inf:
            raise InputError("--mass", "must be a positive number of kg", wish.mass)
        _require_window("--window", wish.window or "all")
        for path in (*wish.masks, *wish.hands, *filter(None, [wish.marks])):
            if not path.exists():
                raise InputError(path, "paths of --masks, --hands and --marks must exist", "no such path")
        self.given = (film / CAPTURE).is_file()
        if self.given and any((wish.mass, wish.frames, wish.intake)):
            rule = "--mass, --frames and --intake must not be combined with a finished capture"
            raise InputError(film, rule, CAPTURE, f'Set "mass" in {CAPTURE}, and select frames with --window.')
        self.capture = film.resolve() if self.given else self.folder / "captures" / self.folder.name
        self.method = wish.method or str(read_yaml(workflow_folder() / "config" / "data" / "own.yaml")["methods"][-1])

    def _with_earlier_options(self, wish: Wish) -> Wish:
        """Complete the options by those of the earlier call. Raises InputError if they contradict the existing capture."""
        earlier = TypeAdapter(Wish).validate_python({"film": wish.film, **self.done.get("options", {})})
        changed = {opt.name for opt in fields(Wish) if getattr(wish, opt.name) not in (opt.default, getattr(earlier, opt.name))}
        taken = {
            name: getattr(earlier, name)
            for name in self.done.get("options", {})
            if name not in changed and getattr(wish, name) != getattr(earlier, name)
        }
        if taken:
            print("Options of the earlier call: " + ", ".join(_option(*option) for option in taken.items()))
        if "capture" in self.done and (other := [name for name in STEP_OPTIONS["capture"] if name in changed]):
            was, now = (", ".join(_option(name, getattr(options, name)) for name in other) for options in (earlier, wish))
            remedy = "Omit these options, choose another --output, or delete this folder."
            raise InputError(self.folder, f"options must match the existing capture, made with {was}", now, remedy)
        return replace(wish, **taken)

    def run(self) -> int:
        """Run the steps that are not done; returns the exit status."""
        try:
            if not self.given:
                self._make_capture()
            self._masks()
            chosen = self._window()
            self._twin(chosen)
        except StepFailed as failed:
            return int(failed.args[0])
        return 0 if self.wish.dry_run else self._tell(self.folder / "results" / chosen.name)

    # --- the steps

    def _make_capture(self) -> None:
        wish, made = self.wish, (self.capture / CAPTURE).is_file()
        words = [*_parts(wish.film.resolve()), "--category", wish.category, "--output", str(self.capture)]
        for name in ("mass", "frames"):
            words += [f"--{name}", str(getattr(wish, name))] if getattr(wish, name) else []
        command = _neuspring("make-capture", *words, *shlex.split(wish.intake))
        self._step("capture", command, made)

    def _masks(self) -> None:
        wish = self.wish
        words = ["--marks", str(wish.marks)] if wish.marks else []
        for name, paths in (("--masks", wish.masks), ("--hands", wish.hands)):
            words += [name, *map(str, paths)] if paths else []
        command = _neuspring("mask", str(self.capture), *words)
        if words:
            # Compares the words after `python -m neuspring`, so that another environment does not repeat the step.
            self._step("masks", command, self._masked() and self.done.get("masks", [])[3:] == command[3:])
        elif self._masked():
            self._say("masks", "exist in the capture")
        else:
            options = ["--no-open"] if wish.no_browser else []
            self._step("masks", _neuspring("annotate", str(self.capture), *options), run=self._annotate)

    def _masked(self) -> bool:
        return (self.capture / CAPTURE).is_file() and read_description(self.capture / CAPTURE).masks

    def _annotate(self, command: list[str], log: Path) -> int:
        """Serve the annotation page until every camera has masks."""
        print("      In the page, outline object and hands, press Carry this camera, and press Save masks.", flush=True)
        with subprocess.Popen(command) as page:
            try:
                while page.poll() is None and not self._masked():
                    time.sleep(LOOK_FOR_MASKS)
                time.sleep(GRACE if page.poll() is None else 0)
            finally:
                if page.poll() is None:
                    page.send_signal(signal.SIGINT)
        failure = "" if self._masked() else "the annotation page ended before masks were saved\n"
        log.write_text(failure, encoding="utf-8")
        print(failure, end="", file=sys.stderr)
        return 2 if failure else 0

    def _window(self) -> Path:
        """Folder of the capture to learn from: all frames, or those of one grasp."""
        log = self._step("check", _neuspring("check-data", str(self.capture)))
        wish, before = self.wish, self.done.get("window", [""])[0]
        proposed = PROPOSED.search(log.read_text(encoding="utf-8")) if log.is_file() else None
        window = wish.window or before or (proposed[1] if proposed else "all")
        if proposed and not (wish.window or before or wish.yes or wish.dry_run):
            if sys.stdin.isatty():
                window = input(f"      The grasp changes. Learn from {window} (one grasp), all, or other frames? ") or window
                _require_window("answer", window)
            print(f"      The twin learns from frames {window}; --window all uses all frames.")
        cut = self.folder / "captures" / f"{self.capture.name}_{window}"
        if window != "all" and (cut / CAPTURE).is_file():
            masks = max((path.stat().st_mtime for path in (self.capture / "mask").glob("*")), default=0.0)
            if masks > (cut / CAPTURE).stat().st_mtime:
                raise InputError(cut, f"must have the present masks of {self.capture}", "older masks", "Delete this folder.")
        elif window != "all":
            cutting = _neuspring("cut-capture", str(self.capture), "--frames", window, "--output", str(cut))
            self._step("check", cutting)
        self._keep("window", [window])
        return self.capture if window == "all" else cut

    def _twin(self, capture: Path) -> None:
        """Run the workflow: observe, search, fit, report."""
        chosen: dict[str, object] = {"scenarios": [capture.name], "methods": list(dict.fromkeys([BESIDE, self.method]))}
        chosen |= {
            "data_root": str(capture.parent),
            "compare_with": BESIDE,
            "results": str(self.folder / "results"),
            "effort": self.wish.effort,
        }
        settings = [f"{key}={value if isinstance(value, str) else json.dumps(value)}" for key, value in chosen.items()]
        options = ["--directory", str(self.folder), "--config", *settings]
        self._step("twin", workflow_command("own", *options, cores=self.wish.cores))

    # --- shared by all steps

    def _step(self, name: str, command: list[str], made: bool = False, run: StepRun | None = None) -> Path:
        """Run a step unless it is `made`; returns its log. Raises StepFailed."""
        log = self.folder / "logs" / f"{TWIN_STEPS.index(name) + 1}_{name}.log"
        print(f"$ {shlex.join(command)}", flush=True)
        if made or self.wish.dry_run:
            self._say(name, "already done" if made else "not run")
            return log
        log.parent.mkdir(parents=True, exist_ok=True)
        self._say(name, "...")
        begun = time.monotonic()
        status = (run or _run)(command, log)
        print(f"      {'failed' if status else duration(time.monotonic() - begun)}", flush=True)
        if status:
            print(f"Step {name} failed with exit status {status}. Output: {log}", file=sys.stderr)
            print(f"Fix the cause, then rerun neuspring twin. To run this step alone:\n  {shlex.join(command)}", file=sys.stderr)
            raise StepFailed(status)
        self._keep(name, command)
        return log

    def _say(self, name: str, text: str, end: str = "\n") -> None:
        print(f"[{TWIN_STEPS.index(name) + 1}/{len(TWIN_STEPS)}] {name} {text}", end=end, flush=True)

    def _keep(self, name: str, words: list[str]) -> None:
        if not self.wish.dry_run:
            self.done[name] = words
            kept = TypeAdapter(Wish).dump_python(self.wish, mode="json", include=set(STEP_OPTIONS.get(name, ())))
            self.done["options"] = self.done.get("options", {}) | kept
            write_text(self.folder / STEPS_DONE, json.dumps(self.done, indent=1) + "\n")

    def _tell(self, scenario: Path) -> int:
        """Print the size of the twin, its errors and those of the baseline, and the files to open."""
        print(_made_of(RunFolder.of(scenario / self.method / "0")), end="")
        print("Errors in mm, future frames (training frames):")
        for method in dict.fromkeys([BESIDE, self.method]):
            scores = RunFolder.of(scenario / method / "0").scores
            errors = 1000 * scores[scores["unit"] == "m"].pivot(index="metric", columns="task", values="value")
            values = [f"{row.Index} {row.future:.1f} ({row.reconstruction:.1f})" for row in errors.dropna().itertuples()]
            print(f"  {method:<16} {', '.join(values)}")
        run = scenario / self.method / "0"
        paths = {"report": self.folder / "results" / "tables" / "report.html", "video": run / "video.mp4"}
        paths |= {"masks, tracks, points": scenario / "perception", "logs": self.folder / "logs"}
        print("".join(f"{name}: {path}\n" for name, path in paths.items() if path.exists()), end="")
        command = _neuspring("play", str(run))
        print(f"play: {shlex.join(command)}", flush=True)
        if self.wish.play:
            os.execv(command[0], command)
        return 0


def _made_of(run: RunFolder) -> str:
    """Line with the numbers of nodes and springs and the invented fraction of the surface; empty without springs."""
    twin, facts = run.twin, {name: value for record in run.records.values() for name, value in record.facts.items()}
    if twin is None:
        return ""
    unseen = facts.get("unseen_surface")
    size = f"Twin: {len(twin.topology.nodes):,} nodes, {len(twin.topology.springs):,} springs"
    return size + (f"; {100 * unseen:.0f} % of its surface is invented, because no camera saw it\n" if unseen else "\n")


def _neuspring(*words: str) -> list[str]:
    return [sys.executable, "-m", "neuspring", *words]


def _run(command: list[str], log: Path) -> int:
    """Run a command with shown and logged output; returns its exit status. After Ctrl-C, waits for its end."""
    # Otherwise Python buffers output to a pipe until the end.
    now = os.environ | {"PYTHONUNBUFFERED": "1"}
    with log.open("w", encoding="utf-8") as output, subprocess.Popen(command, env=now, **JOINED) as process:

        def follow() -> None:
            for line in process.stdout or ():
                output.write(line)
                print(f"      {line}", end="", flush=True)

        try:
            follow()
        except KeyboardInterrupt:
            follow()
            raise
    return process.returncode


def _option(name: str, value: Any) -> str:
    words = value if isinstance(value, tuple) else (value,)
    return f"--{name} {shlex.join(map(str, words))}" if value else f"no --{name}"


def _require_window(where: str, text: str) -> None:
    if not WINDOW.fullmatch(text):
        raise InputError(where, "must be a first and a last frame, as in 12-97, or all", text)


def _parts(film: Path) -> list[str]:
    """Options of make-capture that name the files of a video."""
    if film.is_file() and film.suffix.lower() in MOVIE_ENDINGS:
        return ["--color", str(film)]
    inside = sorted(film.iterdir()) if film.is_dir() else []
    options: list[str] = []
    for option, stems in {"color": ("color", "rgb"), "depth": ("depth",)}.items():
        paths = [path for path in inside if path.stem in stems and (path.is_file() or any(map(Path.is_file, path.iterdir())))]
        options += [f"--{option}", str(paths[0])] if paths else []
    if "--color" not in options:
        return ["--recording", str(film)]
    files = [path for path in inside if path.name == "rig.json"]
    return options + [word for path in files for word in (f"--{path.stem}", str(path))]
