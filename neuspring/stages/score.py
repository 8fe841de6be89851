"""Stage `score`: trajectory -> scores, plots and run.json, the record of the run."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from neuspring.baselines import BASELINES
from neuspring.checks.fitted import SHARE_AT_BOUND
from neuspring.config import plain
from neuspring.core import provenance
from neuspring.core.artifacts import Observations, Twin
from neuspring.core.records import StageRecord, digest_file, now
from neuspring.core.run_folder import RunFolder
from neuspring.core.run_record import RunRecord, flat, key_of
from neuspring.stages.stage import MayFail, Rows, stage
from neuspring.twin.body import code, lines_of

PICTURE_ROLES = ("strip", "video", "turntable")
"""Figures and videos of stage `render`."""
PICTURE_FACTS = ("backend", "masks", "views", "lpips", "unseen_surface")
"""Facts that a reader of image scores needs."""

NOTED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "start": (lambda v: str(v).startswith("seen:"), "without a shape prior, splats begin where something was seen"),
    "rollbacks": (bool, "{rolled_back} of {epochs} epochs rolled back, {epochs_asked} asked for"),
    "collision_overflow": (bool, "the collision list overflowed (raise simulation.collision_capacity)"),
    "at_ends": (bool, "at an end of its range: {at_ends}"),
    "at_bound": (
        lambda v: v > SHARE_AT_BOUND,
        "{at_bound:.0%} of the springs lie at the bound of their stiffness (fit.output_bound)",
    ),
    # Above this fraction, gradients contain little about long motions.
    "frames_left_out": (lambda v: v > 0.05, "{frames_left_out:.0%} of the frames left out of gradients"),
    # Below this fraction, settings have prevented the training of the planes.
    "texels_moved": (lambda v: v < 0.05, "only {texels_moved:.1%} of the texels moved by a tenth of their first scale"),
}
"""Fact of a stage's record -> whether it requires a note, and the note."""


def _variant(rows: Rows) -> dict[str, Any]:
    """The method's search, fit and own settings, for the record of its run."""
    if rows.method is None:
        return {}
    settings: dict[str, Any] = plain(rows.method)["settings"]
    if rows.search is None:
        kind = {"mean_of": rows.method.mean_of} if rows.method.mean_of else {"model": rows.method.model}
        return {"variant": kind | settings}
    switches: dict[str, Any] = {"search": rows.method.search, "clusters": rows.search.clusters, "fit": rows.method.fit or "none"}
    switches |= {"pool": rows.method.pool} if rows.method.pool else {}
    # Only oracles have this key; they are excluded from comparisons.
    switches |= {"oracle": True} if rows.method.oracle else {}
    quirks = rows.search.released_quirks
    switches |= {"released_quirks": sorted(key for key, on in quirks.items() if on)} if quirks else {}
    return {"variant": switches | settings}


@stage(output="{scenario}/{method}/{seed}/run.json", rule="run", code=lambda settings, given: code(), given=_variant)
def score(
    observations: Observations,
    rollout: MayFail,
    method: str,
    output: Path,
    search: MayFail | None = None,
    fit: MayFail | None = None,
    train: MayFail | None = None,
    appearance: MayFail | None = None,
    render: MayFail | None = None,
    variant: dict[str, Any] | None = None,
    seed: int = 0,
) -> None:
    """Trajectory -> scores, plots and run.json, the record of the run, which MLflow indexes.

    Inputs are the records of the method's stages: rollout; search and fit, or train, if they exist; for scenarios with images
    appearance and render. `variant` contains the method's own settings. For a failed run, held.parquet contains the scores with
    its last frame repeated to the end.
    """
    import pandas as pd

    from neuspring.core.files import write_table
    from neuspring.draw import run as figures
    from neuspring.scores import metrics

    began, folder = time.perf_counter(), output.parent
    given = {"search": search, "fit": fit, "train": train, "rollout": rollout, "appearance": appearance, "render": render}
    stages = RunFolder(folder, {name: before for name, before in given.items() if before})
    scenario, trajectory, frames_file = observations.scenario, stages.trajectory, stages.file("render", "frames")
    pictures = pd.read_parquet(frames_file) if frames_file else None
    errors = metrics.errors_per_frame(trajectory.positions, observations) if trajectory else None
    scores = metrics.score_run(trajectory, pictures, observations, method, seed, errors)
    write_table(scores, folder / "scores.parquet")
    if rollout.record.status == "failed":
        frozen = metrics.last_frame_frozen(trajectory, observations)
        write_table(metrics.score_run(frozen, pictures, observations, method, seed), folder / "held.parquet")

    paths = {name: before.path for name, before in stages.stages.items()}
    learned = [name for name in stages.learning if stages.stages[name].has("history")]
    histories = {name: paths[name].with_name("history.parquet") for name in learned}
    searched = stages.file("search", "twin")
    plots = figures.run_figures(
        observations,
        trajectory,
        {name: pd.read_parquet(path) for name, path in histories.items()},
        method,
        folder / "plots",
        errors=errors,
        twin=stages.twin,
        # The search gives every spring the same stiffness.
        searched=lines_of(Twin.load(searched)).typical if searched else None,
    )
    artifacts = {"records": list(paths.values())} | ({"twin": [stages.twin_file]} if stages.twin_file else {}) | {"plots": plots}
    if pictures is not None:
        named = [stages.file("appearance", "picture"), *(stages.file("render", role) for role in PICTURE_ROLES)]
        artifacts["images"] = [path for path in named if path]
        shown = pictures[pictures["frame"] < len(trajectory.positions)] if trajectory is not None else pictures
        plots.append(figures.image_scores_figure(shown, scenario, method, folder / "plots"))

    records = stages.records
    content: dict[str, Any] = {
        "scenario": scenario.name,
        "method": method,
        "variant": flat(variant or {}),
        "seed": seed,
        "status": rollout.record.status,
        "reason": rollout.record.reason,
        "notes": _notes(records),
        "settings": {name: record.settings for name, record in records.items()},
        "data_digest": rollout.record.inputs["observations"],
    }
    params: dict[str, Any] = {"method": variant or {}}
    for name, record in records.items():
        params |= {name: record.settings, f"{name}.result": record.facts}
    RunRecord(
        **content,
        # Outside of `content`: the reason why LPIPS was not computed contains paths of this machine.
        images=_picture_facts(records),
        floors=metrics.floors(observations),
        run_key=key_of(content, stages.results | {"scores": digest_file(folder / "scores.parquet")}),
        source=scenario.source,
        category=scenario.category,
        attempt=max(record.attempts for record in records.values()),
        commit=provenance.commit(),
        device=stages.maker.device,
        started=min(record.started for record in records.values()),
        ended=now(),
        params=flat(params),
        timings={n: record.seconds for n, record in records.items()} | {"score": round(time.perf_counter() - began, 3)},
        peak_memory_mb={name: record.peak_memory_mb for name, record in records.items()},
        machine=rollout.record.machine,
        versions=stages.maker.versions,
        scores_file="scores.parquet",
        held_file="held.parquet" if rollout.record.status == "failed" else None,
        histories={name: _relative(path, folder) for name, path in histories.items()},
        artifacts={name: [_relative(path, folder) for path in files] for name, files in artifacts.items()},
    ).save(output)


def _picture_facts(records: Mapping[str, StageRecord]) -> dict[str, Any] | None:
    """How images were scored, or why they were not; None for scenarios without images."""
    if "render" not in records:
        return None
    facts = records["render"].facts
    return {name: facts[name] for name in PICTURE_FACTS} if facts else {"failed": records["render"].reason}


def _notes(records: Mapping[str, StageRecord]) -> list[str]:
    """Notes that a reader of the scores needs although the run did not fail."""
    noted_facts = NOTED | {key: note for baseline in BASELINES.values() for key, note in baseline.notes.items()}
    notes = []
    render = records.get("render")
    if render and render.status == "failed" and records["rollout"].status == "ok":
        notes.append(f"no scores of pictures: {render.reason}")
    if render and render.facts.get("empty_frames"):
        notes.append(f"render: {render.facts['empty_frames']} frames show nothing of the object and have no PSNR")
    for name, record in records.items():
        facts = record.facts | {"rolled_back": len(record.facts.get("rollbacks", ()))}
        notes += [
            f"{name}: {text.format(**facts)}" for key, (noted, text) in noted_facts.items() if key in facts and noted(facts[key])
        ]
    return notes


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()
