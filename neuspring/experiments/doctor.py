"""What this machine can do: interpreter, libraries, devices, weights, disk, MLflow; and the next move where one is missing.

broken: the configuration needs it and it is missing. absent: it is missing and not needed.
"""

from __future__ import annotations

import importlib.util
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from neuspring.baselines.spring_gaus import VGG16, find_vgg16
from neuspring.config import Config, ScenarioRow, Toy
from neuspring.core.device import resolve_device, start_warp
from neuspring.core.errors import InputError
from neuspring.core.extras import EXTRAS, install
from neuspring.core.text import masked
from neuspring.core.weights import hub_folder
from neuspring.experiments import needs
from neuspring.experiments.tracking import store
from neuspring.perception.track_cotracker import ADDRESS, WEIGHTS
from neuspring.scenes.synthetic import toy
from neuspring.scores import lpips
from neuspring.splats.rasterize import choose_backend, rasterize
from neuspring.splats.view import View
from neuspring.twin.rollout import roll_out

State = Literal["ok", "absent", "broken"]
FREE_GB = 20.0
"""GB that the results of the whole benchmark take at most; less free space is told."""
PARITY_POSITION, PARITY_COLOR = 2e-5, 2e-5
"""m and intensity by which CUDA may differ from the CPU: the limits of the tests against golden clips and pictures."""
DOWNLOAD = "curl -L --create-dirs -o"


@dataclass(frozen=True)
class Check:
    """One line of the report."""

    subject: str
    state: State
    detail: str
    remedy: str = ""
    """The next move, where something is absent or broken."""


def examine(settings: Config) -> list[Check]:
    """All checks, for what a configuration asks for."""
    return [*_libraries(settings), *_devices(settings), *_weights(settings), *_storage(settings)]


def text(checks: list[Check]) -> str:
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


def _libraries(settings: Config) -> Iterator[Check]:
    yield Check("Python", "ok", sys.version.split()[0])
    cuda = f"CUDA {torch.version.cuda}" if torch.version.cuda else "build for the CPU"
    yield Check("torch", "ok", f"{torch.__version__}, {cuda}")
    for package in ("warp-lang", "snakemake", "mlflow", "optuna"):
        try:
            yield Check(package, "ok", version(package))
        except PackageNotFoundError:
            yield Check(package, "broken", "not installed", "make install")
    segments = settings.perception.segment.backend == "grounded_sam2"
    wanted = {
        "gsplat": settings.images.backend == "gsplat",
        "transformers": segments,
        "torchvision": segments,
        "psycopg2": bool(settings.tune and settings.tune.storage),
    }
    for module, extra in EXTRAS.items():
        if importlib.util.find_spec(module):
            yield Check(module, "ok", f"extra {extra}")
        else:
            yield Check(module, "broken" if wanted.get(module) else "absent", f"extra {extra} is not installed", install(extra))
    if importlib.util.find_spec("av"):
        import av

        try:
            av.codec.Codec("libx264", "w")
            yield Check("H.264 encoder", "ok", f"libx264, av {av.__version__}")
        except (ValueError, LookupError) as error:
            remedy = "Install av from its wheel: .venv/bin/pip install --force-reinstall av"
            yield Check("H.264 encoder", "broken", str(error), remedy)


def _checked(subject: str, examined: Callable[[], str], remedy: str = "") -> Check:
    """What `examined` says; broken where it raises InputError."""
    try:
        return Check(subject, "ok", examined())
    except InputError as error:
        return Check(subject, "broken", str(error), remedy)


def _devices(settings: Config) -> Iterator[Check]:
    import warp as wp

    found = _checked("device", lambda: resolve_device(settings.device), "Set device: cpu, or install what the message names.")
    yield found
    if found.state == "broken":
        return
    device = found.detail
    start_warp()
    yield Check("Warp devices", "ok", ", ".join(str(one.alias) for one in wp.get_devices()))
    leased = _checked("GPUs that jobs may lease", lambda: ", ".join(needs.gpu_pool(settings.gpus, settings.device)))
    none = Check(leased.subject, "absent", "none: jobs run on the CPU", "Set gpus.devices, or CUDA_VISIBLE_DEVICES.")
    yield leased if leased.detail else none
    yield _checked("rasterizer", lambda: choose_backend(settings.images.backend, device))
    if device.startswith("cuda"):
        yield from _parity(device)


def _parity(device: str) -> Iterator[Check]:
    """Simulator and rasterizer on CUDA against the CPU, in a few seconds after kernels are compiled."""
    row = ScenarioRow(
        scenario="parity", source="toy", category="cloth", path="cloth/lift/smooth", self_collision=False, ground=True
    )
    scene = toy.make(row, Toy(frames=11))
    hands = scene.observations.controller_points
    positions = [roll_out(scene.truth, hands, where).positions for where in ("cpu", device)]
    pictures = [_small_picture(where) for where in ("cpu", device)]
    for what, difference, limit, unit in (
        ("simulator", float(np.abs(positions[0] - positions[1]).max()), PARITY_POSITION, "m in 10 frames"),
        ("rasterizer", float((pictures[0] - pictures[1]).abs().max()), PARITY_COLOR, "in color"),
    ):
        detail = f"{difference:.1e} {unit} from the CPU's (limit {limit:.0e})"
        yield Check(f"{what} on {device}", "ok" if difference <= limit else "broken", detail, "Use device: cpu, and report this.")


def _small_picture(device: str) -> torch.Tensor:
    """RGB [H, W, 3] of 50 random splats."""
    random, size = np.random.default_rng(0), 64

    def tensor(values: Any) -> torch.Tensor:
        return torch.tensor(np.asarray(values), dtype=torch.float32, device=device)

    intrinsics = tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    return rasterize(
        tensor(random.uniform([-0.4, -0.4, 0.8], [0.4, 0.4, 1.2], (50, 3))),
        tensor(random.normal(size=(50, 4))),
        tensor(random.uniform(0.01, 0.1, (50, 3))),
        tensor(random.uniform(0.2, 0.9, 50)),
        tensor(random.uniform(0, 1, (50, 3))),
        View(torch.eye(4, device=device), intrinsics, size, size),
        backend="warp",
    ).rgb.cpu()


def _weights(settings: Config) -> Iterator[Check]:
    from huggingface_hub import try_to_load_from_cache

    # Files that are known by their checksum.
    hub = hub_folder()
    checked = {
        "LPIPS (AlexNet)": (
            lambda: lpips.configured_weights(settings.images.lpips),
            f"{DOWNLOAD} {hub / lpips.BACKBONE} {lpips.BACKBONE_ADDRESS}; .venv/bin/pip install --no-deps lpips",
        ),
        "VGG16 (Spring-Gaus' features)": (
            lambda: find_vgg16(settings.baselines.spring_gaus.vgg16),
            f"{DOWNLOAD} {hub / VGG16} https://download.pytorch.org/models/{VGG16}",
        ),
    }
    for subject, (find, remedy) in checked.items():
        try:
            place = find()
        except InputError as error:
            yield Check(subject, "broken", str(error))
            continue
        if isinstance(place, str):
            yield Check(subject, "absent", f"{place}; what needs it is left out, and tables say so", remedy)
        else:
            yield Check(subject, "ok", "checksum is right")
    # Weights of perception, which their libraries keep in caches of their own.
    segment, track = settings.perception.segment, settings.perception.track
    for subject, name in {
        "GroundingDINO": segment.grounded_sam2.detector,
        "SAM 2": segment.grounded_sam2.video_model,
    }.items():
        there = Path(name).is_dir() or isinstance(try_to_load_from_cache(name, "config.json"), str)
        wanted = segment.backend == "grounded_sam2" and not segment.grounded_sam2.download
        remedy = f".venv/bin/hf download {name}, or perception.segment.grounded_sam2.download: true"
        detail = name if there else f"{name} is not in the cache of the Hugging Face hub"
        yield Check(subject, "ok" if there else "broken" if wanted else "absent", detail, remedy)
    code = sorted(Path(torch.hub.get_dir()).glob("facebookresearch_co-tracker_*"))
    there = bool(code) and (hub_folder() / WEIGHTS).is_file()
    wanted = track.backend == "cotracker3" and not track.cotracker3.download
    remedy = (
        f"perception.track.cotracker3.download: true (not for commercial use), or {DOWNLOAD} {hub_folder() / WEIGHTS} {ADDRESS}"
    )
    detail = WEIGHTS if there else "code or weights are not in the cache of torch.hub"
    yield Check("CoTracker3", "ok" if there else "broken" if wanted else "absent", detail, remedy)


def _storage(settings: Config) -> Iterator[Check]:
    results = Path(settings.results)
    place = next(folder for folder in (results.resolve(), *results.resolve().parents) if folder.is_dir())
    free = shutil.disk_usage(place).free / 1e9
    remedy = "Choose another folder: --config results=..."
    yield Check("disk", "ok" if free >= FREE_GB else "absent", f"{free:.0f} GB free for {settings.results}", remedy)
    if settings.data_root is not None:
        there = Path(settings.data_root).is_dir()
        yield Check("data_root", "ok" if there else "broken", str(settings.data_root), "Give the folder of the data.")
    if not settings.tracking.enabled:
        yield Check("MLflow store", "absent", "tracking.enabled: false")
        return
    uri = masked(store.uri_of(results, settings.tracking))
    try:
        state = "it answers" if store.find(results, settings.tracking) else "made by the first run"
        yield Check("MLflow store", "ok", f"{uri}: {state}")
    except Exception as error:  # whatever MLflow or a database raises
        reason = str(error).partition("\n")[0]
        remedy = "Start the server, or correct tracking.uri; runs wait on disk meanwhile (neuspring sync)."
        yield Check("MLflow store", "broken", f"{uri}: {reason}", remedy)
