"""Checks of the machine: interpreter, libraries, devices and weights, with the next move for each missing item.

A missing item is `broken` if the configuration needs it, else `absent`.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from neuspring.baselines import BASELINES
from neuspring.config import Config
from neuspring.core.device import resolve_device
from neuspring.core.errors import InputError
from neuspring.core.extras import EXTRAS, install
from neuspring.core.weights import hub_folder
from neuspring.perception import segment_sam2
from neuspring.perception.track_cotracker import WEIGHTS, WEIGHTS_URL
from neuspring.scores import lpips
from neuspring.splats.rasterize import choose_backend

State = Literal["ok", "absent", "broken"]
DOWNLOAD = "curl -L --create-dirs -o"


@dataclass(frozen=True)
class MachineCheck:
    """One line of the report."""

    subject: str
    state: State
    detail: str
    remedy: str = ""
    """The next move for an absent or broken item."""


def examine(settings: Config) -> list[MachineCheck]:
    """Run all checks for a configuration."""
    return [*_libraries(settings), *_devices(settings), *_weights(settings)]


def text(checks: list[MachineCheck]) -> str:
    """The report: one line per check, its next move below it, and the verdict."""
    signs = {"ok": "ok     ", "absent": "absent ", "broken": "BROKEN "}
    width = max(len(check.subject) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"{signs[check.state]}{check.subject.ljust(width)}  {check.detail}")
        if check.remedy and check.state != "ok":
            lines.append(f"{' ' * (len(signs['ok']) + width + 2)}-> {check.remedy}")
    broken = [check.subject for check in checks if check.state == "broken"]
    verdict = f"The configuration needs: {', '.join(broken)}." if broken else "This machine can run the configuration."
    return "\n".join([*lines, "", verdict])


def _check(subject: str, present: bool, needed: bool, detail: str, remedy: str = "") -> MachineCheck:
    return MachineCheck(subject, "ok" if present else "broken" if needed else "absent", detail, remedy)


def _libraries(settings: Config) -> Iterator[MachineCheck]:
    cuda = f"CUDA {torch.version.cuda}" if torch.version.cuda else "build for the CPU"
    yield MachineCheck("Python, torch", "ok", f"{sys.version.split()[0]}, {torch.__version__}, {cuda}")
    segments = settings.perception.segment.backend == "grounded_sam2"
    needed = {
        "gsplat": settings.images.backend == "gsplat",
        "transformers": segments,
        "torchvision": segments,
        "psycopg2": bool(settings.tune and settings.tune.storage),
    }
    for module, extra in EXTRAS.items():
        present = importlib.util.find_spec(module) is not None
        yield _check(
            module, present, needed.get(module, False), f"extra {extra}" + " is not installed" * (not present), install(extra)
        )


def _devices(settings: Config) -> Iterator[MachineCheck]:
    try:
        device = resolve_device(settings.device)
        rasterizer = choose_backend(settings.images.backend, device)
    except InputError as error:
        yield MachineCheck("device", "broken", str(error), "Set device: cpu, or install the missing library.")
        return
    yield MachineCheck("device", "ok", f"{device}; rasterizer {rasterizer}")


def _weights(settings: Config) -> Iterator[MachineCheck]:
    from huggingface_hub import try_to_load_from_cache

    hub, segment, track = hub_folder(), settings.perception.segment, settings.perception.track
    # Without these files the metric or loss term is omitted, and tables say so.
    lpips_remedy = f"{DOWNLOAD} {hub / lpips.BACKBONE} {lpips.BACKBONE_ADDRESS}; .venv/bin/pip install --no-deps lpips"
    checked: list[tuple[str, Path | str | tuple[Path, ...], str]] = [("LPIPS (AlexNet)", lpips.find_weights(), lpips_remedy)]
    for weights in filter(None, (baseline.weights for baseline in BASELINES.values())):
        checked.append((weights.what, weights.find(), f"{DOWNLOAD} {hub / weights.file} {weights.address}"))
    for subject, files, remedy in checked:
        yield _check(subject, not isinstance(files, str), False, files if isinstance(files, str) else "correct checksum", remedy)
    for subject, name in {"GroundingDINO": segment_sam2.DETECTOR, "SAM 2": segment_sam2.VIDEO_MODEL}.items():
        present = isinstance(try_to_load_from_cache(name, "config.json"), str)
        needed = segment.backend == "grounded_sam2" and not segment.grounded_sam2.download
        remedy = f".venv/bin/hf download {name}, or perception.segment.grounded_sam2.download: true"
        yield _check(subject, present, needed, name, remedy)
    present = any(Path(torch.hub.get_dir()).glob("facebookresearch_co-tracker_*")) and (hub / WEIGHTS).is_file()
    remedy = f"perception.track.download: true (not for commercial use), or {DOWNLOAD} {hub / WEIGHTS} {WEIGHTS_URL}"
    yield _check("CoTracker3", present, track.backend == "cotracker3" and not track.download, WEIGHTS, remedy)
