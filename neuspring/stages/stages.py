"""The steps of the workflow: read records and artefacts, compute, write artefacts, then the record.

Each function is one rule and one `neuspring` command. The record is written last. A numerical failure is recorded and passed
on; anything else raises.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring import config
from neuspring.config import Config, Kind, ScenarioRow
from neuspring.core import provenance
from neuspring.core.artifacts import Observations, Trajectory, Twin
from neuspring.core.checkpoint import checkpoint_key
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.files import write_history, write_table, write_text
from neuspring.core.records import RECORD_FORMAT, StageRecord, Stopwatch, canonical, digest_file, now
from neuspring.scores import metrics

RESULT_ROLES = ("twin", "model", "trajectory", "centres")
"""Files of a stage that are its result, as opposed to how it got there."""
LEARNING = ("search", "fit", "train")
"""Stages that learn, in order, where a run has them; the last of them made its model."""
PICTURE_ROLES = ("strip", "video", "turntable")
"""Files of the render stage to look at."""
PICTURE_FACTS = ("backend", "masks", "views", "lpips", "quirks", "unseen_surface")
"""What a reader of image scores must know."""


def observe(
    row: ScenarioRow, settings: Config, output: Path, capture: Path | None = None, lifted_record: Path | None = None
) -> None:
    """Capture -> observations.npz; for toy scenes also truth.npz beside it (never read by a method).

    Raw video has been perceived before: `capture` is its folder, `lifted_record` its lifted.json.
    """
    location = Path(settings.data_root or ".") / row.path
    if row.source in config.FILMED:
        from neuspring.stages.perceive import assemble

        if capture is None or lifted_record is None:
            rule = f"scenarios of source {row.source} need --capture and --lifted"
            raise InputError(f"scenario {row.scenario}", rule, "neither", "Run neuspring capture, segment, track and lift first.")
        observations = assemble(row, capture, lifted_record, settings)
    elif row.source == "toy":
        from neuspring.data.synthetic import toy

        scene = toy.make(row, settings.toy)
        scene.truth.save(output.with_name("truth.npz"))
        observations = scene.observations
    elif row.source == "mocap":
        from neuspring.data import mocap

        observations = mocap.read(row, location, settings.mocap)
    else:
        from neuspring.data import phystwin

        observations = phystwin.read(row, location)
    observations.save(output)


def search(observations_path: Path, settings: Config, clusters: int, seed: int, device: str, output: Path) -> None:
    """Observations -> coarse twin (twin.npz), search.json, and trace.parquet with every candidate, its cost and variables.

    A trace that is already there is continued from if it fits, so a larger `search.rollouts` costs only the difference.
    """
    from neuspring.core.device import resolve_device
    from neuspring.twin.search import SearchProblem
    from neuspring.twin.search import search as run

    clock = Stopwatch()
    observations = Observations.load(observations_path)
    device = resolve_device(device)
    sections = (settings.search, settings.simulation, settings.losses, settings.released_quirks)
    problem = SearchProblem(observations, *sections, device, clusters)
    chosen = {name: config.plain(getattr(settings, name)) for name in ("search", "simulation", "losses", "released_quirks")}
    common: dict[str, Any] = {
        "inputs": {"observations": digest_file(observations_path)},
        "settings": chosen | {"clusters": clusters, "seed": seed},
        "device": device,
    }
    # The budget is not part of the key: a search with a larger one begins with the same candidates.
    same = common["settings"] | {"search": {name: value for name, value in chosen["search"].items() if name != "rollouts"}}
    key = checkpoint_key(common["inputs"], same, device, "neuspring.twin.search")
    trace = output.with_name("trace.parquet")
    try:
        result = run(problem, seed, record=trace, key=key)
    except NumericalFailure as failure:
        clock.stage("search", "failed", reason=str(failure), **common).save(output)
        return
    folder = output.parent
    result.twin.save(folder / "twin.npz")
    costs = result.trace["cost"]
    write_history(costs.index, {"cost": costs, "best_cost": costs.cummin()}, folder / "history.parquet")
    files = {"twin": folder / "twin.npz", "trace": trace, "history": folder / "history.parquet"}
    facts = {
        **result.values,
        "cost": result.cost,
        "rollouts": len(result.trace),
        "failed_rollouts": int((result.trace["reason"] != "").sum()),
        "collision_overflow": int(result.trace["collision_overflow"].max()),
        **_twin_facts(result.twin),
    }
    clock.stage(
        "search", "ok", files, facts=facts, attempts=result.attempts, earlier_seconds=result.earlier_seconds, **common
    ).save(output)


def fit(observations_path: Path, search_record: Path, settings: Config, kind: Kind, device: str, output: Path) -> None:
    """Observations + coarse twin -> fitted twin (twin.npz), losses per epoch (history.parquet), fit.json.

    `kind` says what is trained: each spring by itself, or the neural spring field, whose first weights follow the search's seed.
    """
    from neuspring.core.device import resolve_device
    from neuspring.twin.fit import FitProblem
    from neuspring.twin.fit import fit as run

    clock = Stopwatch()
    observations, before = Observations.load(observations_path), StageRecord.load(search_record)
    device = resolve_device(device)
    chosen = {name: config.plain(getattr(settings, name)) for name in ("fit", "simulation", "losses", "released_quirks")}
    inputs = {"observations": digest_file(observations_path), "search": digest_file(search_record)}
    # The seed is the search's; it also draws a field's first weights.
    seed = before.settings["seed"]
    common: dict[str, Any] = {"inputs": inputs, "settings": chosen | {"kind": kind, "seed": seed}, "device": device}
    if before.status == "failed":
        clock.stage("fit", "failed", reason=f"search: {before.reason}", **common).save(output)
        return
    coarse = Twin.load(before.file("twin", search_record))
    sections = (settings.fit, settings.simulation, settings.losses, settings.released_quirks)
    problem = FitProblem(observations, coarse, *sections, device, kind, int(seed))
    same = {"observations": inputs["observations"], "twin": before.files["twin"][1]}
    key = checkpoint_key(same, common["settings"], device, "neuspring.twin.fit")
    partial = output.with_name("fit.partial.npz")
    try:
        result = run(problem, partial=partial, key=key)
    except NumericalFailure as failure:
        clock.stage("fit", "failed", reason=str(failure), **common).save(output)
        return
    folder = output.parent
    result.twin.save(folder / "twin.npz")
    columns = {name: result.history[name] for name in ("loss", "tail_loss", "gradient_norm", "learning_rate")}
    write_history(result.history["epoch"], columns, folder / "history.parquet")
    facts = {
        "best_epoch": result.best_epoch,
        "best_loss": result.best_loss,
        "epochs": len(result.history),
        "rollbacks": result.rollbacks,
        "collision_overflow": result.collision_overflow,
        **_twin_facts(result.twin),
    }
    files = {"twin": folder / "twin.npz", "history": folder / "history.parquet"}
    clock.stage("fit", "ok", files, facts=facts, attempts=result.attempts, earlier_seconds=result.earlier_seconds, **common).save(
        output
    )
    partial.unlink(missing_ok=True)


def rollout(observations_path: Path, twin_records: Sequence[Path], carry: bool, device: str, output: Path) -> None:
    """Twin + controllers of all frames -> trajectory.npz, rollout.json. Divergence is recorded as a failure.

    Several records: the mean of their trajectories. `carry` corrects the state at the last training frame by what was observed
    there, where training frames say that it helps.
    """
    from neuspring.core.device import resolve_device
    from neuspring.twin.carry import carry_over
    from neuspring.twin.motion import initial_velocity
    from neuspring.twin.rollout import mean_trajectory, roll_out

    clock = Stopwatch()
    observations, device = Observations.load(observations_path), resolve_device(device)
    before = {path: StageRecord.load(path) for path in twin_records}
    common: dict[str, Any] = {
        "inputs": {"observations": digest_file(observations_path)}
        | {f"{record.stage}{index or ''}": digest_file(path) for index, (path, record) in enumerate(before.items())},
        "settings": {"carry_over": carry},
        "device": device,
    }
    broken = next((record for record in before.values() if record.status == "failed"), None)
    if broken:
        clock.stage("rollout", "failed", reason=f"{broken.stage}: {broken.reason}", **common).save(output)
        return
    trajectories, carried = [], []
    for path, record in before.items():
        twin = Twin.load(record.file("twin", path))
        velocity = initial_velocity(observations, twin.simulation.initial_velocity)
        trajectory = roll_out(twin, observations.controller_points, device, velocity=velocity)
        if carry:
            trajectory, found = carry_over(trajectory, twin, observations, velocity, device)
            carried.append(found)
        trajectories.append(trajectory)
    # A diverged rollout ends earlier; the mean would hide that.
    trajectory = next((one for one in trajectories if one.diverged_frame is not None), None) or mean_trajectory(trajectories)
    facts: dict[str, Any] = {"frames": len(trajectory.positions), "averaged": len(trajectories)}
    if carried:
        facts |= {f"carry_over_{name}": float(np.mean([found[name] for found in carried])) for name in carried[0]}
    path = output.with_name("trajectory.npz")
    trajectory.save(path)
    if trajectory.collision_overflow:
        print("warning: collision candidates did not fit the list; raise simulation.collision_capacity")
    failed = trajectory.diverged_frame is not None
    facts["collision_overflow"] = trajectory.collision_overflow
    reason = f"rollout: {trajectory.reason}" if failed else ""
    clock.stage("rollout", "failed" if failed else "ok", {"trajectory": path}, reason=reason, facts=facts, **common).save(output)


def transfer(
    targets: Sequence[Path], twin_record: Path, method: str, seed: int, settings: Config, device: str, output: Path
) -> None:
    """What was learned from one recording -> scores on other recordings of the same object (transfer.parquet), transfer.json.

    `twin_record` names a twin, or a trained GS-Dynamics model. All frames after the first of a target count (task `transfer`); with
    observed initial velocities the first two of them also set the start. A twin's rest lengths are re-based on the target's rest
    shape, unless they were trained. A rollout that diverges leaves out its target.
    """
    from neuspring.core.device import resolve_device

    clock = Stopwatch()
    before, device = StageRecord.load(twin_record), resolve_device(device)
    inputs = {before.stage: digest_file(twin_record)} | {f"target{i}": digest_file(path) for i, path in enumerate(targets)}
    tables, diverged = [pd.DataFrame(columns=list(metrics.COLUMNS))], []
    predict = _elsewhere(before, twin_record, settings, device) if before.status == "ok" else None
    for path in targets if predict else ():
        observations = Observations.load(path)
        assert predict is not None
        trajectory = predict(observations)
        frames = range(1, observations.scenario.frame_count)
        if trajectory.diverged_frame is not None:
            diverged.append(observations.scenario.name)
        tables.append(metrics.score_tasks(trajectory, observations, method, seed, {"transfer": frames}))
    path = write_table(pd.concat([table for table in tables if len(table)] or tables), output.with_name("transfer.parquet"))
    facts = {"diverged": diverged, "targets": len(targets)}
    clock.stage("transfer", before.status, {"scores": path}, reason=before.reason, facts=facts, inputs=inputs, device=device).save(
        output
    )


def _elsewhere(before: StageRecord, path: Path, settings: Config, device: str) -> Callable[[Observations], Trajectory]:
    """How what a record names predicts another recording."""
    if before.stage == "train":
        from neuspring.baselines.gs_dynamics.model import GsDynamicsModel
        from neuspring.baselines.gs_dynamics.predict import predict

        model = GsDynamicsModel.load(before.file("model", path))
        return lambda observations: predict(model, observations, device).trajectory
    from neuspring.twin.motion import initial_velocity
    from neuspring.twin.rollout import roll_out
    from neuspring.twin.transfer import rebase

    twin = Twin.load(before.file("twin", path))
    keep_lengths = bool(before.settings.get("fit", {}).get("rest_length_bound"))
    keep_frame_time = before.settings["released_quirks"]["frame_time_667"]

    def roll(observations: Observations) -> Trajectory:
        safety = settings.simulation.safety
        moved = rebase(twin, observations, safety=safety, keep_lengths=keep_lengths, keep_frame_time=keep_frame_time)
        velocity = initial_velocity(observations, moved.simulation.initial_velocity)
        return roll_out(moved, observations.controller_points, device, velocity=velocity)

    return roll


def score(
    observations_path: Path, records: Mapping[str, Path], method: str, variant: Mapping[str, Any], seed: int, output: Path
) -> None:
    """Trajectory -> scores.parquet, plots, and run.json: the record of the whole run, which MLflow indexes.

    `records` maps the method's stages (search and fit, or train, if any), rollout and, for scenarios with images, appearance and
    render to their records. A run that failed also gets held.parquet: its scores with the last frame that there is held.
    """
    clock = Stopwatch()
    observations = Observations.load(observations_path)
    stages = {name: StageRecord.load(path) for name, path in records.items()}
    last, folder = stages["rollout"], output.parent
    # Only this stage draws, and matplotlib takes half a second of the start of a job.
    from neuspring.report.figures import run as figures

    trajectory = Trajectory.load(last.file("trajectory", records["rollout"])) if "trajectory" in last.files else None
    table = pd.DataFrame(columns=list(metrics.COLUMNS))
    if trajectory is not None:
        table = metrics.score(trajectory, observations, method, seed)
    drawn = _drawn(stages, records)
    if drawn is not None and trajectory is not None:
        table = _with_pictures(table, drawn, len(trajectory.positions), observations, method, seed)
    write_table(table, folder / "scores.parquet")
    held_file = _write_held(trajectory, drawn, observations, method, seed, folder) if last.status == "failed" else None
    learned = [name for name in LEARNING if name in stages]
    histories = {name: records[name].parent / "history.parquet" for name in learned if "history" in _files(stages, name)}
    twin_stage = "fit" if "fit" in stages else "search"
    maker = stages[learned[-1] if learned else "rollout"]
    artefacts = {"records": list(records.values())}
    twin, searched = (_twin(stages, records, name) for name in (twin_stage, "search"))
    if twin is not None:
        artefacts["twin"] = [stages[twin_stage].file("twin", records[twin_stage])]
    artefacts["plots"] = figures.run_figures(
        observations,
        trajectory,
        {name: pd.read_parquet(path) for name, path in histories.items()},
        method,
        folder / "plots",
        twin=twin,
        # The search gives every spring the same stiffness.
        searched=None if searched is None else float(np.median(searched.material.stiffness)),
    )
    if drawn is not None:
        artefacts["images"] = [stages["appearance"].file("picture", records["appearance"])]
        artefacts["images"] += [
            stages["render"].file(role, records["render"]) for role in PICTURE_ROLES if role in _files(stages, "render")
        ]
        shown = drawn[drawn["frame"] < len(trajectory.positions)] if trajectory is not None else drawn
        artefacts["plots"].append(figures.image_scores_figure(shown, observations.scenario, method, folder / "plots"))
    content = {
        "scenario": observations.scenario.name,
        "method": method,
        "variant": _flat(variant),
        "seed": seed,
        "status": last.status,
        "reason": last.reason,
        "notes": _notes(stages),
        "settings": {name: record.settings for name, record in stages.items()},
        "data_digest": digest_file(observations_path),
    }
    # The content of a run, without its timings: the same results have the same key, however often they are made.
    made = {name: record.files[role][1] for name, record in stages.items() for role in RESULT_ROLES if role in record.files}
    made["scores"] = digest_file(folder / "scores.parquet")
    run = content | {
        # Beside the content: why LPIPS was not computed names places on this machine.
        "images": _picture_facts(stages),
        "format": RECORD_FORMAT,
        "run_key": hashlib.sha256(canonical([content, made]).encode()).hexdigest(),
        "source": observations.scenario.source,
        "category": observations.scenario.category,
        "attempt": max(record.attempts for record in stages.values()),
        "commit": provenance.commit(),
        "device": maker.device,
        "started": min(record.started for record in stages.values()),
        "ended": now(),
        "params": _parameters(stages, variant),
        "timings": {name: record.seconds for name, record in stages.items()} | {"score": round(clock.seconds, 3)},
        "peak_memory_mb": {name: record.peak_memory_mb for name, record in stages.items()},
        "machine": last.machine,
        "versions": maker.versions,
        "scores_file": "scores.parquet",
        "held_file": held_file,
        "histories": {name: _relative(path, folder) for name, path in histories.items()},
        "artifacts": {name: [_relative(path, folder) for path in paths] for name, paths in artefacts.items()},
    }
    write_text(output, json.dumps(run, indent=1, sort_keys=True, allow_nan=False) + "\n")


def _with_pictures(
    table: pd.DataFrame, drawn: pd.DataFrame, frames: int, observations: Observations, method: str, seed: int
) -> pd.DataFrame:
    """Scores, and those of the first `frames` pictures."""
    pictured = metrics.score_images(drawn, observations.scenario, frames, method, seed)
    return pd.concat([part for part in (table, pictured) if len(part)] or [table], ignore_index=True)


def _write_held(
    trajectory: Trajectory | None,
    drawn: pd.DataFrame | None,
    observations: Observations,
    method: str,
    seed: int,
    folder: Path,
) -> str:
    """held.parquet, and its name: scores with the last frame held, or frame 0 where there is none."""
    whole = metrics.last_frame_frozen(trajectory, observations)
    table = metrics.score(whole, observations, method, seed)
    if drawn is not None:
        table = _with_pictures(table, drawn, len(whole.positions), observations, method, seed)
    return write_table(table, folder / "held.parquet").name


def _drawn(stages: Mapping[str, StageRecord], records: Mapping[str, Path]) -> pd.DataFrame | None:
    """Scores of pictures per frame, if the scenario has images and they could be drawn."""
    if "frames" not in _files(stages, "render"):
        return None
    return pd.read_parquet(stages["render"].file("frames", records["render"]))


def _picture_facts(stages: Mapping[str, StageRecord]) -> dict[str, Any] | None:
    """How pictures were scored, or why they were not; None for scenarios without images."""
    if "render" not in stages:
        return None
    facts = stages["render"].facts
    return {name: facts[name] for name in PICTURE_FACTS} if facts else {"failed": stages["render"].reason}


def _notes(stages: Mapping[str, StageRecord]) -> list[str]:
    """What a reader of the scores should know although the run did not fail."""
    notes = []
    rendered = stages.get("render")
    if rendered and rendered.status == "failed" and stages["rollout"].status == "ok":
        notes.append(f"no scores of pictures: {rendered.reason}")
    if rendered and rendered.facts.get("empty_frames"):
        notes.append(f"render: {rendered.facts['empty_frames']} frames show nothing of the object and have no PSNR")
    for name, record in stages.items():
        if str(record.facts.get("start", "")).startswith("seen:"):
            notes.append(f"{name}: without a shape prior, splats begin where something was seen")
        if record.facts.get("vgg16", "computed") not in ("computed", "not asked for"):
            # Not why: that names places on this machine.
            notes.append(f"{name}: without the loss of VGG16's features, whose weights are not there")
        if record.facts.get("links") == 0:
            notes.append(f"{name}: no anchor lies near a controller in frame 0, so the hands move nothing")
        if record.facts.get("rollbacks"):
            wanted = record.settings["fit"]["epochs"]
            count = len(record.facts["rollbacks"])
            notes.append(f"{name}: {count} of {record.facts['epochs']} epochs rolled back, {wanted} asked for")
        if record.facts.get("collision_overflow"):
            notes.append(f"{name}: the collision list overflowed (raise simulation.collision_capacity)")
    return notes


def _files(stages: Mapping[str, StageRecord], name: str) -> dict[str, list[str]]:
    return stages[name].files if name in stages else {}


def _twin(stages: Mapping[str, StageRecord], records: Mapping[str, Path], name: str) -> Twin | None:
    """The twin that a stage made, if it made one."""
    return Twin.load(stages[name].file("twin", records[name])) if "twin" in _files(stages, name) else None


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()


def _twin_facts(twin: Twin) -> dict[str, Any]:
    return {
        "nodes": len(twin.topology.nodes),
        "springs": len(twin.topology.springs),
        "object_springs": twin.topology.object_spring_count,
        "substeps": twin.simulation.substeps,
    }


def _parameters(stages: Mapping[str, StageRecord], variant: Mapping[str, Any]) -> dict[str, Any]:
    """Flat parameters for MLflow: settings and facts of each stage."""
    nested: dict[str, Any] = {"method": variant}
    for name, record in stages.items():
        nested |= {name: record.settings, f"{name}.result": record.facts}
    return _flat(nested)


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values under dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat
