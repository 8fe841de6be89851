"""The Python interface: `import neuspring as ns`.

    run = ns.load_run()  # the sample twin, or "results/<scenario>/<method>/<seed>"
    print(run.summary())
    ns.show(ns.roll_out(run.twin, run.observations), run.observations)

The workflow's stages call the same functions, so results are equal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neuspring.config import Config, parse, plain
from neuspring.config.settings import read_settings as settings_of
from neuspring.core.artifacts import Observations, Topology, Trajectory, Twin
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.run_folder import RunFolder
from neuspring.data.sample import sample_twin

if TYPE_CHECKING:
    import pandas as pd

    from neuspring.draw.show import InlinePicture
    from neuspring.twin.body import Learned

__all__ = [
    "Observations", "Topology", "Trajectory", "Twin",
    "fit", "load_run", "move", "roll_out", "sample_twin", "score", "search", "show", "twin_from_capture", "with_mass",
]  # fmt: skip
Settings = Config | Mapping[str, Any] | Path | str | None
"""A `Config`, values as in a YAML file (`{"fit": {"epochs": 60}}`), YAML files separated by commas, or None: the defaults."""


def load_run(folder: Path | str | None = None) -> RunFolder:
    """Load a run, `results/<scenario>/<method>/<seed>`, with `twin`, `trajectory`, `observations`, `scores` and `records`.

    Without a folder, load the twin that is part of the package (`sample_twin`). Raises InputError if the folder contains no run.
    The properties raise InputError if their file is missing, damaged or of another version.
    """
    run = RunFolder.of(sample_twin() if folder is None else Path(folder))
    if not run.stages:
        remedy = "Name a folder results/<scenario>/<method>/<seed>, for example of `make demo`."
        raise InputError(folder, "must be the folder of a run", "no record of a stage", remedy)
    return run


def twin_from_capture(
    folder: Path | str,
    settings: Settings = None,
    *,
    output: Path | str = "results/python",
    mass: float | None = None,
    clusters: int | None = None,
    body: str = "lattice",
    kind: str | None = None,
    seed: int = 0,
    device: str = "auto",
    threads: int = 1,
) -> RunFolder:
    """Fit a twin to a capture folder: perceive, search, fit, predict and score with the workflow's stages; returns the run.

    Files have the workflow's layout in `output`; the run is `output`/<name of the folder>/python/<seed>. An interrupted search
    resumes. `config/data/own.yaml` contains settings for a laptop. `mass`, kg, rescales the twin (`with_mass`). `clusters`,
    `body` and `kind` are passed to `search` and `fit`.

    Raises InputError, and NumericalFailure if search or fit fails.
    """
    from neuspring.core.records import StageRecord
    from neuspring.data.capture import CAPTURE
    from neuspring.data.capture import Capture as CaptureFolder
    from neuspring.scenes.sources import row_of_capture
    from neuspring.stages import STAGES

    folder = Path(folder).absolute()
    row, cameras = row_of_capture(folder / CAPTURE), tuple(CaptureFolder.load(folder).cameras)
    read = dataclasses.replace(read_settings(settings), data_root=str(folder.parent))
    regions, method = read.clusters if clusters is None else clusters, "python"
    kind = kind or {"lattice": "field"}.get(body, body)
    common = {"capture": folder / CAPTURE, "scenario": row, "clusters": regions, "body": body, "kind": kind, "method": method}
    common |= {"seed": seed, "device": device, "threads": threads}
    common |= {"variant": {"search": body, "clusters": regions, "fit": kind}}

    def made(name: str, **given: Any) -> Path:
        stage = STAGES[name]
        wildcards = {"scenario": row.scenario, "search": method, "method": method, "seed": seed, **given}
        path: Path = Path(output) / stage.output.format(**wildcards)
        path.parent.mkdir(parents=True, exist_ok=True)
        stage(output=path, settings=read, **{key: value for key, value in (common | given).items() if key in stage.parameters})
        if name in ("search", "fit") and (record := StageRecord.load(path)).status == "failed":
            raise NumericalFailure(record.reason)
        return path

    lifted: dict[str, Path] = {}
    if cameras:
        masks = [made("segment", camera=camera) for camera in cameras]
        tracks = [made("track", camera=camera, masks=path) for camera, path in zip(cameras, masks, strict=True)]
        lifted = {"lifted": made("lift", masks=masks, tracks=tracks)}
    observed = {"observations": made("observe", **lifted)}
    learned = {"search": made("search", **observed)}
    learned |= {"fit": made("fit", **observed, **learned)}
    run = made("score", **observed, **learned, rollout=made("rollout", **observed, learned=learned["fit"])).parent
    loaded = load_run(run)
    if mass is not None and loaded.twin is not None:
        vars(loaded)["twin"] = with_mass(loaded.twin, mass)
    return loaded


def with_mass(twin: Twin, mass: float) -> Twin:
    """The twin with the total `mass`, kg, and unchanged motion. By default a node has 1 kg, because a video shows no weight.

    All values in N or kg are multiplied by the same factor. Raises InputError unless the mass is positive.
    """
    from neuspring.twin.body import with_mass as weighed

    if not 0 < mass < np.inf:
        raise InputError("mass", "a positive number of kg is required", mass)
    return weighed(twin, mass)


def show(
    what: RunFolder | Twin | Trajectory,
    observations: Observations | None = None,
    output: Path | str | None = None,
    *,
    film: bool = False,
) -> InlinePicture:
    """Draw a run, a twin or a prediction; a notebook shows the result if it is the last value of a cell.

    A twin is colored by stiffness. A prediction is drawn in a few frames, next to the `observations` if they are given; a run has
    its own. `film` draws all frames as a GIF. `output` is a file to write: a figure (.png, .jpg, .svg, .pdf) or a video (.gif,
    .mp4). Raises InputError.
    """
    from neuspring.draw.show import show as drawn

    return drawn(what, observations, None if output is None else Path(output), film)


def roll_out(twin: Twin, hands: Observations | np.ndarray, device: str = "auto") -> Trajectory:
    """Simulate a twin from frame 0 with moving controllers, as the workflow does: positions [T, N, 3], m.

    `hands` are observations, or the positions of all controllers in all frames [T, C, 3], m; frame 0 must match the twin. If the
    rollout diverges, the trajectory ends early and has a `diverged_frame` and a `reason`. Raises InputError for another shape.
    """
    from neuspring.core.device import resolve_device
    from neuspring.twin import rollout
    from neuspring.twin.body import body_of

    device, twin = resolve_device(device), body_of(twin).for_prediction(twin)
    if isinstance(hands, Observations):
        velocity = rollout.initial_velocity(hands, twin.simulation.initial_velocity)
        return rollout.roll_out(twin, hands.controller_points, device, velocity=velocity, valid=hands.controller_valid)
    paths, controllers = np.asarray(hands), len(twin.topology.controllers)
    if paths.ndim != 3 or paths.shape[1:] != (controllers, 3) or not len(paths):
        raise InputError("hands", f"must be observations, or positions [T, {controllers}, 3] in meters", paths.shape)
    return rollout.roll_out(twin, paths, device)


def move(twin: Twin, observations: Observations, settings: Settings = None) -> Twin:
    """Move a twin to frame 0 of another recording of its object; `roll_out` then predicts that recording.

    Nodes must be in the same order in both. Raises InputError for a recording of another object.
    """
    from neuspring.twin.transfer import move as moved

    simulation = read_settings(settings).simulation
    return moved(twin, observations, safety=simulation.safety, rest_lengths=simulation.rest_lengths)


def score(trajectory: Trajectory, observations: Observations) -> pd.DataFrame:
    """Mean errors of a prediction, m: one row per task (reconstruction: training frames; future) and metric."""
    from neuspring.scores import metrics

    return metrics.score(trajectory, observations, method="", seed=0)[["task", "metric", "value", "unit", "frames"]]


def search(
    observations: Observations,
    settings: Settings = None,
    *,
    clusters: int | None = None,
    body: str = "lattice",
    seed: int = 0,
    device: str = "auto",
    threads: int = 1,
    record: Path | None = None,
) -> Learned:
    """Search material and topology with CMA-ES; returns the best `twin`, its `cost` and the `trace`.

    The topology has `clusters` regions, by default the number in the settings; 1 is uniform. The trace is written to the file
    `record`, from which an interrupted search resumes. Packages may add values of `body`. Raises InputError and NumericalFailure.
    """
    from neuspring.core.device import resolve_device
    from neuspring.twin.body import BODIES, SearchOptions

    read, device = read_settings(settings), resolve_device(device)
    regions = read.clusters if clusters is None else clusters
    options = SearchOptions(clusters=regions, seed=seed, device=device, threads=threads, record=record)
    return BODIES[body].search(observations, (), read, options)


def fit(
    observations: Observations,
    twin: Twin,
    settings: Settings = None,
    *,
    kind: str = "field",
    seed: int = 0,
    device: str = "auto",
    checkpoint: Path | None = None,
    mass: float | None = None,
) -> Learned:
    """Fit a twin's stiffness with gradients through the simulation; returns the best `twin` and the `history` of losses.

    `kind`: a neural spring field (field) or every spring separately (springs); other bodies have other kinds (`Body.fits`).
    `mass`, kg, rescales the twin (`with_mass`). From the file `checkpoint`, an interrupted fit of the same twin, observations and
    settings resumes. Raises InputError and NumericalFailure.
    """
    from neuspring.core.checkpoint import checkpoint_key
    from neuspring.core.device import resolve_device
    from neuspring.twin.body import body_of
    from neuspring.twin.fit import FitProblem

    read = read_settings(settings)
    problem = FitProblem(
        observations=observations,
        twin=twin,
        fit=read.fit,
        simulation=read.simulation,
        losses=read.losses,
        quirks=read.released_quirks,
        device=resolve_device(device),
        kind=kind,
        seed=seed,
    )
    # The key excludes the number of epochs: a longer fit starts with the same epochs.
    made_of = {name: plain(getattr(read, name)) for name in ("fit", "simulation", "losses", "released_quirks")}
    made_of["fit"].pop("epochs")
    inputs = {"twin": twin.digest, "observations": observations.digest}
    key = checkpoint_key(inputs, made_of | {"kind": kind, "seed": seed}, problem.device, "neuspring.twin.fit")
    learned = body_of(twin).fit(problem, partial=checkpoint, key=key)
    return learned if mass is None else dataclasses.replace(learned, twin=with_mass(learned.twin, mass))


def read_settings(settings: Settings) -> Config:
    """Read settings from any of their forms. Raises InputError for unknown keys and invalid values."""
    if isinstance(settings, Config):
        return settings
    if settings is None or isinstance(settings, Mapping):
        return parse(Config, settings or {}, "settings")
    return settings_of(str(settings))
