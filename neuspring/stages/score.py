"""Trajectory -> scores, plots and run.json, the record of the whole run."""

from __future__ import annotations

import os
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.core import provenance
from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.core.files import write_table
from neuspring.core.records import StageRecord, digest_file, now
from neuspring.core.run_record import RESULT_ROLES, RunRecord, flat, key_of
from neuspring.report.figures import run as figures
from neuspring.scores import metrics
from neuspring.stages import LEARNING
from neuspring.stages import options as shared
from neuspring.twin.hand_paths import with_hands

STAGES_BEFORE = ("search", "fit", "train", "rollout", "appearance", "render")
PICTURE_ROLES = ("strip", "video", "turntable")
"""Files of the render stage to look at."""
PICTURE_FACTS = ("backend", "masks", "views", "lpips", "quirks", "unseen_surface")
"""What a reader of image scores must know."""

HELD = 0.05
"""A share of springs at their bound above this, or of texels that moved below it, says that the settings were in training's way."""


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring score`."""
    shared.add_observations(parser)
    for stage in STAGES_BEFORE:
        where = "the scenario has images" if stage in ("appearance", "render") else "the method has that stage"
        required = stage == "rollout"
        shared.add_record(parser, stage, f"{stage}.json" + ("" if required else f", if {where}"), required=required)
    parser.add_argument("--method", required=True)
    parser.add_argument("--variant", default="{}", help="JSON: the method's switches")
    shared.add_seed(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring score`."""
    records = {name: path for name in STAGES_BEFORE if (path := getattr(a, name))}
    run(a.observations, records, a.method, shared.json_mapping("--variant", a.variant), a.seed, a.output)


@dataclass(frozen=True)
class Stages:
    """The stages of a run: name -> path of its record."""

    paths: Mapping[str, Path]

    @cached_property
    def records(self) -> dict[str, StageRecord]:
        """Name -> record."""
        return {name: StageRecord.load(path) for name, path in self.paths.items()}

    def file(self, stage: str, role: str) -> Path | None:
        """The file that a stage names; None if the run has no such stage or the stage no such file."""
        record = self.records.get(stage)
        return record.file(role, self.paths[stage]) if record and role in record.files else None

    @property
    def twin_file(self) -> Path | None:
        """The run's twin; None if it has none."""
        return self.file("fit" if "fit" in self.paths else "search", "twin")

    @property
    def learning(self) -> list[str]:
        """The stages that learned the run's model, in order."""
        return [name for name in LEARNING if name in self.paths]

    @property
    def maker(self) -> StageRecord:
        """The stage that made the run's model; of what learns nothing, the rollout."""
        return self.records[self.learning[-1] if self.learning else "rollout"]

    @property
    def results(self) -> dict[str, str]:
        """Stage -> digest of its result."""
        return {
            name: record.files[role][1] for name, record in self.records.items() for role in RESULT_ROLES if role in record.files
        }


def run(
    observations_path: Path, records: Mapping[str, Path], method: str, variant: Mapping[str, Any], seed: int, output: Path
) -> None:
    """Write scores.parquet, plots, and `output`, the record of the whole run, which MLflow indexes.

    `records` maps the method's stages to their records: search and fit, or train, if any; rollout; of scenarios with images,
    appearance and render. A run that failed also gets held.parquet: its scores with the last frame frozen that it reached.
    """
    began, folder = time.perf_counter(), output.parent
    stages = Stages(records)
    rollout = stages.records["rollout"]
    observations = Observations.load(observations_path)
    if stages.twin_file:
        observations = with_hands(observations, Twin.load(stages.twin_file))
    trajectory_file, frames_file = stages.file("rollout", "trajectory"), stages.file("render", "frames")
    trajectory = Trajectory.load(trajectory_file) if trajectory_file else None
    pictures = pd.read_parquet(frames_file) if frames_file else None
    scores = pd.DataFrame(columns=list(metrics.COLUMNS))
    if trajectory is not None:
        scores = metrics.score(trajectory, observations, method, seed)
        if pictures is not None:
            scores = _with_pictures(scores, pictures, len(trajectory.positions), observations, method, seed)
    write_table(scores, folder / "scores.parquet")
    frozen_file = _write_frozen(trajectory, pictures, observations, method, seed, folder) if rollout.status == "failed" else None
    histories = {name: path.parent / "history.parquet" for name, path in records.items() if _learned_steps(stages, name)}
    artifacts = {"records": list(records.values())} | _artifacts(
        stages, observations, trajectory, pictures, histories, method, folder
    )
    content: dict[str, Any] = {
        "scenario": observations.scenario.name,
        "method": method,
        "variant": flat(variant),
        "seed": seed,
        "status": rollout.status,
        "reason": rollout.reason,
        "notes": _notes(stages.records),
        "settings": {name: record.settings for name, record in stages.records.items()},
        "data_digest": digest_file(observations_path),
    }
    seconds = {name: record.seconds for name, record in stages.records.items()} | {"score": round(time.perf_counter() - began, 3)}
    RunRecord(
        **content,
        # Why LPIPS was not computed names places on this machine: beside the content, not in it.
        images=_picture_facts(stages.records),
        floors=metrics.floors(observations),
        run_key=key_of(content, stages.results | {"scores": digest_file(folder / "scores.parquet")}),
        source=observations.scenario.source,
        category=observations.scenario.category,
        attempt=max(record.attempts for record in stages.records.values()),
        commit=provenance.commit(),
        device=stages.maker.device,
        started=min(record.started for record in stages.records.values()),
        ended=now(),
        params=_parameters(stages.records, variant),
        timings=seconds,
        peak_memory_mb={name: record.peak_memory_mb for name, record in stages.records.items()},
        machine=rollout.machine,
        versions=stages.maker.versions,
        scores_file="scores.parquet",
        held_file=frozen_file,
        histories={name: _relative(path, folder) for name, path in histories.items()},
        artifacts={name: [_relative(path, folder) for path in paths] for name, paths in artifacts.items()},
    ).save(output)


def _learned_steps(stages: Stages, name: str) -> bool:
    return name in LEARNING and "history" in stages.records[name].files


def _artifacts(
    stages: Stages,
    observations: Observations,
    trajectory: Trajectory | None,
    pictures: pd.DataFrame | None,
    histories: Mapping[str, Path],
    method: str,
    folder: Path,
) -> dict[str, list[Path]]:
    """Kind -> files to look at or to load: the twin, plots that are drawn now, pictures of earlier stages."""
    artifacts: dict[str, list[Path]] = {}
    twin_file = stages.twin_file
    searched_file = stages.file("search", "twin")
    if twin_file:
        artifacts["twin"] = [twin_file]
    artifacts["plots"] = figures.run_figures(
        observations,
        trajectory,
        {name: pd.read_parquet(path) for name, path in histories.items()},
        method,
        folder / "plots",
        twin=Twin.load(twin_file) if twin_file else None,
        # The search gives every spring the same stiffness.
        searched=float(np.median(Twin.load(searched_file).material.stiffness)) if searched_file else None,
    )
    if pictures is not None:
        named = [stages.file("appearance", "picture"), *(stages.file("render", role) for role in PICTURE_ROLES)]
        artifacts["images"] = [path for path in named if path]
        shown = pictures[pictures["frame"] < len(trajectory.positions)] if trajectory is not None else pictures
        artifacts["plots"].append(figures.image_scores_figure(shown, observations.scenario, method, folder / "plots"))
    return artifacts


def _with_pictures(
    scores: pd.DataFrame, pictures: pd.DataFrame, frames: int, observations: Observations, method: str, seed: int
) -> pd.DataFrame:
    """Scores, and those of the first `frames` pictures."""
    pictured = metrics.score_images(pictures, observations.scenario, frames, method, seed)
    return pd.concat([part for part in (scores, pictured) if len(part)] or [scores], ignore_index=True)


def _write_frozen(
    trajectory: Trajectory | None,
    pictures: pd.DataFrame | None,
    observations: Observations,
    method: str,
    seed: int,
    folder: Path,
) -> str:
    """Write held.parquet: scores with the last finite frame repeated, or frame 0 where there is none. Returns the file's name."""
    frozen = metrics.last_frame_frozen(trajectory, observations)
    scores = metrics.score(frozen, observations, method, seed)
    if pictures is not None:
        scores = _with_pictures(scores, pictures, len(frozen.positions), observations, method, seed)
    return write_table(scores, folder / "held.parquet").name


def _picture_facts(records: Mapping[str, StageRecord]) -> dict[str, Any] | None:
    """How pictures were scored, or why they were not; None for scenarios without images."""
    if "render" not in records:
        return None
    facts = records["render"].facts
    return {name: facts[name] for name in PICTURE_FACTS} if facts else {"failed": records["render"].reason}


def _notes(records: Mapping[str, StageRecord]) -> list[str]:
    """What a reader of the scores must know although the run did not fail."""
    notes = []
    render = records.get("render")
    if render and render.status == "failed" and records["rollout"].status == "ok":
        notes.append(f"no scores of pictures: {render.reason}")
    if render and render.facts.get("empty_frames"):
        notes.append(f"render: {render.facts['empty_frames']} frames show nothing of the object and have no PSNR")
    for name, record in records.items():
        if str(record.facts.get("start", "")).startswith("seen:"):
            notes.append(f"{name}: without a shape prior, splats begin where something was seen")
        if record.facts.get("vgg16", "computed") not in ("computed", "not asked for"):
            # Not why: that names places on this machine.
            notes.append(f"{name}: without the loss of VGG16's features, whose weights are not there")
        if record.facts.get("links") == 0:
            notes.append(f"{name}: no anchor lies near a controller in frame 0, so the hands move nothing")
        if record.facts.get("rollbacks"):
            epochs, wanted = record.facts["epochs"], record.facts["epochs_asked"]
            notes.append(f"{name}: {len(record.facts['rollbacks'])} of {epochs} epochs rolled back, {wanted} asked for")
        if record.facts.get("collision_overflow"):
            notes.append(f"{name}: the collision list overflowed (raise simulation.collision_capacity)")
        if record.facts.get("at_ends"):
            notes.append(f"{name}: at an end of its range: {record.facts['at_ends']}")
        if record.facts.get("at_bound", 0.0) > HELD:
            notes.append(
                f"{name}: {record.facts['at_bound']:.0%} of the springs lie at the bound of their stiffness (fit.output_bound)"
            )
        if record.facts.get("texels_moved", 1.0) < HELD:
            notes.append(f"{name}: only {record.facts['texels_moved']:.1%} of the texels moved by a tenth of their first scale")
    return notes


def _parameters(records: Mapping[str, StageRecord], variant: Mapping[str, Any]) -> dict[str, Any]:
    """Settings and facts of all stages, under dotted names."""
    nested: dict[str, Any] = {"method": variant}
    for name, record in records.items():
        nested |= {name: record.settings, f"{name}.result": record.facts}
    return flat(nested)


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()
