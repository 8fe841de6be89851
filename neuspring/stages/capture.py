"""Stage `capture`: a synthetic scene, or data in PhysTwin's raw layout -> a capture folder."""

from __future__ import annotations

from pathlib import Path

from neuspring.config import Config, ScenarioRow
from neuspring.data.capture import CAPTURE
from neuspring.scenes.sources import SOURCES, write_capture
from neuspring.stages.stage import stage, there


@stage(
    output="{scenario}/capture/capture.json",
    rule="perceive",
    reads=lambda settings, given: SOURCES[given["scenario"].source].reads,
    code=lambda settings, given: (SOURCES[given["scenario"].source].write_capture,),
    minutes=120,
    when=lambda rows: bool(rows.source.write_capture and (rows.source.films or rows.images)),
    instead=lambda rows: rows.data / CAPTURE if rows.data else None,
    also=lambda rows: there(rows.data, rows.source.capture_files),
    stamp=lambda rows: rows.image_stamps,
)
def capture(scenario: ScenarioRow, settings: Config, output: Path) -> None:
    """Synthetic scene or PhysTwin's raw layout -> capture folder, whose capture.json is `output`.

    The truth of a synthetic scene is written next to the folder; no method reads it.
    """
    write_capture(scenario, settings, output.parent)
