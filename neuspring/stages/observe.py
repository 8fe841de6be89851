"""Stage `observe`: a capture, or processed data -> observations.npz."""

from __future__ import annotations

from pathlib import Path

from neuspring.config import Config, ScenarioRow
from neuspring.core.errors import InputError
from neuspring.core.records import CAPTURE_FOLDER, Before, Recorder
from neuspring.data.capture import Capture
from neuspring.scenes.sources import SOURCES, read_observations
from neuspring.stages.stage import stage, there


@stage(
    output="{scenario}/observations.npz",
    rule="perceive",
    reads=lambda settings, given: (
        ("perception.sample",) if SOURCES[given["scenario"].source].films else SOURCES[given["scenario"].source].reads
    ),
    code=lambda settings, given: () if SOURCES[given["scenario"].source].films else (SOURCES[given["scenario"].source].module,),
    without=lambda rows: () if rows.source.films else ("capture",),
    also=lambda rows: () if rows.source.films else there(rows.data, rows.source.files),
)
def observe(
    scenario: ScenarioRow, settings: Config, output: Path, capture: Capture | None = None, lifted: Before | None = None
) -> None:
    """Capture, or processed data -> observations.npz; for a toy scene also truth.npz, which no method reads.

    For raw video, `capture` and `lifted` are the results of perception, and a record with findings is written next to the
    observations. Raises InputError for observations that no method can use.
    """
    if not SOURCES[scenario.source].films:
        read_observations(scenario, settings, output).save(output)
        return
    if capture is None or lifted is None:
        rule = f"source {scenario.source} requires --capture and --lifted"
        raise InputError(f"scenario {scenario.scenario}", rule, "neither", "Run neuspring capture, segment, track and lift first.")
    from neuspring.checks.perceived import look_at_observations
    from neuspring.core.artifacts import ImageObservations
    from neuspring.core.findings import findings_as_facts, refuse_errors
    from neuspring.data.results import LiftedTracks, ShapePrior
    from neuspring.perception.sample import assemble

    record = Recorder("observe", output.with_suffix(".json"), inputs={"lifted": lifted.path})
    points, prior = LiftedTracks.load(lifted.file("lifted")), ShapePrior.load(lifted.file("shape"))
    image = ImageObservations.load(lifted.file("image")) if lifted.has("image") else None
    observations = assemble(scenario, capture, points, prior, settings.perception, image)
    findings = look_at_observations(observations, points.facts.get("object_moves", 0.0))
    facts = findings_as_facts(findings)
    # Unusable observations must not be saved, because a search would start from them.
    refuse_errors(findings)
    observations.save(output)
    # A user's capture is outside of the results folder; figures find it through this fact.
    here = {CAPTURE_FOLDER: str(capture.folder.absolute())}
    record.save({"observations": output}, {"nodes": len(observations.nodes), **here, **facts})
