"""A capture, or processed data -> observations.npz."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from neuspring.config import Config, ScenarioRow
from neuspring.core.errors import InputError
from neuspring.core.findings import refuse_errors, told
from neuspring.core.records import Recorder, StageRecord
from neuspring.data.sources import SOURCES, read_observations
from neuspring.stages import options as shared


def options(parser: ArgumentParser) -> None:
    """Add the options of `neuspring observe`."""
    shared.add_scenario(parser)
    shared.add_capture(parser, required=False, help="capture.json of raw video")
    shared.add_record(parser, "lifted", "lifted.json of raw video", required=False)
    shared.add_settings(parser)
    shared.add_output(parser)


def command(a: Namespace) -> None:
    """`neuspring observe`."""
    settings = shared.read_settings(a.settings)
    run(shared.read_row(a, settings), settings, a.output, a.capture and a.capture.parent, a.lifted)


def run(row: ScenarioRow, settings: Config, output: Path, capture: Path | None = None, lifted_record: Path | None = None) -> None:
    """Write observations.npz; of a toy scene also truth.npz beside it, which no method reads.

    Raw video has been perceived before: `capture` is its folder, `lifted_record` its lifted.json. Then a record with what was
    noticed lies beside the observations. Raises InputError for observations that no method can work with.
    """
    if not SOURCES[row.source].films:
        read_observations(row, settings, output).save(output)
        return
    if capture is None or lifted_record is None:
        rule = f"scenarios of source {row.source} need --capture and --lifted"
        raise InputError(f"scenario {row.scenario}", rule, "neither", "Run neuspring capture, segment, track and lift first.")
    # Imported here: processed data need nothing of perception, whose code must not start their jobs again.
    from neuspring.core.artifacts import ImageObservations
    from neuspring.data.capture import Capture
    from neuspring.perception.findings import look_at_observations
    from neuspring.perception.results import LiftedTracks, ShapePrior
    from neuspring.perception.sample import assemble

    record = StageRecord.load(lifted_record)
    lifted = LiftedTracks.load(record.file("lifted", lifted_record))
    prior = ShapePrior.load(record.file("shape", lifted_record))
    recorder = Recorder("observe", output.with_suffix(".json"), inputs={"lifted": lifted_record})
    image = ImageObservations.load(record.file("image", lifted_record)) if "image" in record.files else None
    observations = assemble(row, Capture.load(capture), lifted, prior, settings.perception, image)
    findings = look_at_observations(observations)
    facts = told(findings)
    # Before the observations are there: what no method can work with starts no search.
    refuse_errors(findings)
    observations.save(output)
    recorder.save({"observations": output}, {"nodes": len(observations.nodes), **facts})
