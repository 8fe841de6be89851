"""The machine: interpreter, libraries, devices, weights; and the next move where one is missing.

broken: the configuration needs it and it is missing. absent: it is missing and not needed.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

import torch

from neuspring.baselines import BASELINES
from neuspring.config import Config
from neuspring.core.device import resolve_device, start_warp
from neuspring.core.errors import InputError
from neuspring.core.extras import EXTRAS, install
from neuspring.core.weights import hub_folder
from neuspring.experiments import needs
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
    """The next move, where something is absent or broken."""


def examine(settings: Config) -> list[MachineCheck]:
    """All checks, for what a configuration asks for."""
    return [*_libraries(settings), *_devices(settings), *_weights(settings)]


def text(checks: list[MachineCheck]) -> str:
    """The report: a line each, its next move below it, and the verdict."""
    signs = {"ok": "ok     ", "absent": "absent ", "broken": "BROKEN "}
    width = max(len(check.subject) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"{signs[check.state]}{check.subject.ljust(width)}  {check.detail}")
        if check.remedy and check.state != "ok":
            lines.append(f"{' ' * (len(signs['ok']) + width + 2)}-> {check.remedy}")
    broken = [check.subject for check in checks if check.state == "broken"]
    verdict = f"Cannot work as configured: {', '.join(broken)}." if broken else "Everything that is configured can work here."
    return "\n".join([*lines, "", verdict])


def _libraries(settings: Config) -> Iterator[MachineCheck]:
    yield MachineCheck("Python", "ok", sys.version.split()[0])
    cuda = f"CUDA {torch.version.cuda}" if torch.version.cuda else "build for the CPU"
    yield MachineCheck("torch", "ok", f"{torch.__version__}, {cuda}")
    for package in ("warp-lang", "snakemake", "mlflow", "optuna"):
        try:
            yield MachineCheck(package, "ok", version(package))
        except PackageNotFoundError:
            yield MachineCheck(package, "broken", "not installed", "make install")
    segments = settings.perception.segment.backend == "grounded_sam2"
    wanted = {
        "gsplat": settings.images.backend == "gsplat",
        "transformers": segments,
        "torchvision": segments,
        "psycopg2": bool(settings.tune and settings.tune.storage),
    }
    for module, extra in EXTRAS.items():
        if importlib.util.find_spec(module):
            yield MachineCheck(module, "ok", f"extra {extra}")
        else:
            told = f"extra {extra} is not installed", install(extra)
            yield MachineCheck(module, "broken" if wanted.get(module) else "absent", *told)
    if importlib.util.find_spec("av"):
        import av

        try:
            av.codec.Codec("libx264", "w")
            yield MachineCheck("H.264 encoder", "ok", f"libx264, av {av.__version__}")
        except (ValueError, LookupError) as error:
            remedy = "Install av from its wheel: .venv/bin/pip install --force-reinstall av"
            yield MachineCheck("H.264 encoder", "broken", str(error), remedy)


def _checked(subject: str, examined: Callable[[], str], remedy: str = "") -> MachineCheck:
    """The text of `examined`; broken where it raises InputError."""
    try:
        return MachineCheck(subject, "ok", examined())
    except InputError as error:
        return MachineCheck(subject, "broken", str(error), remedy)


def _devices(settings: Config) -> Iterator[MachineCheck]:
    import warp as wp

    found = _checked("device", lambda: resolve_device(settings.device), "Set device: cpu, or install what the message names.")
    yield found
    if found.state == "broken":
        return
    device = found.detail
    start_warp()
    yield MachineCheck("Warp devices", "ok", ", ".join(str(one.alias) for one in wp.get_devices()))
    leased = _checked("GPUs that jobs may lease", lambda: ", ".join(needs.gpu_pool(settings.gpus, settings.device)))
    none = MachineCheck(leased.subject, "absent", "none: jobs run on the CPU", "Set gpus.devices, or CUDA_VISIBLE_DEVICES.")
    yield leased if leased.detail else none
    yield _checked("rasterizer", lambda: choose_backend(settings.images.backend, device))


def _weights(settings: Config) -> Iterator[MachineCheck]:
    from huggingface_hub import try_to_load_from_cache

    # Files that are known by their checksum.
    hub = hub_folder()
    checked: dict[str, tuple[Callable[[], object], str]] = {
        "LPIPS (AlexNet)": (
            lpips.find_weights,
            f"{DOWNLOAD} {hub / lpips.BACKBONE} {lpips.BACKBONE_ADDRESS}; .venv/bin/pip install --no-deps lpips",
        )
    }
    for baseline in BASELINES.values():
        if weights := baseline.weights:
            checked[weights.what] = (weights.find, f"{DOWNLOAD} {hub / weights.file} {weights.address}")
    for subject, (find, remedy) in checked.items():
        place = find()
        if isinstance(place, str):
            yield MachineCheck(subject, "absent", f"{place}; what needs it is left out, and tables say so", remedy)
        else:
            yield MachineCheck(subject, "ok", "checksum is right")
    # Weights of perception, which their libraries keep in caches of their own.
    segment, track = settings.perception.segment, settings.perception.track
    for subject, name in {"GroundingDINO": segment_sam2.DETECTOR, "SAM 2": segment_sam2.VIDEO_MODEL}.items():
        there = isinstance(try_to_load_from_cache(name, "config.json"), str)
        wanted = segment.backend == "grounded_sam2" and not segment.grounded_sam2.download
        remedy = f".venv/bin/hf download {name}, or perception.segment.grounded_sam2.download: true"
        detail = name if there else f"{name} is not in the cache of the Hugging Face hub"
        yield MachineCheck(subject, "ok" if there else "broken" if wanted else "absent", detail, remedy)
    code = sorted(Path(torch.hub.get_dir()).glob("facebookresearch_co-tracker_*"))
    there = bool(code) and (hub_folder() / WEIGHTS).is_file()
    wanted = track.backend == "cotracker3" and not track.download
    download = f"{DOWNLOAD} {hub_folder() / WEIGHTS} {WEIGHTS_URL}"
    remedy = f"perception.track.download: true (not for commercial use), or {download}"
    detail = WEIGHTS if there else "code or weights are not in the cache of torch.hub"
    yield MachineCheck("CoTracker3", "ok" if there else "broken" if wanted else "absent", detail, remedy)
