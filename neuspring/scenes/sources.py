"""Sources of scenarios: `SOURCES` declares every kind of data; all other code reads it.

To add a source, write a module that reads its data, add a `Source` here, and add lines to the scenario table. A source with
settings also needs a section of `neuspring.config.data`. A package adds a `Source` with an entry point of the group
`neuspring.sources`. The module contains

    observe(row, path, config, output) -> Observations     for data without video; it may write the truth next to `output`
    write_capture(row, path, config, folder)                for video, or images next to processed data

`path` is the location of the data.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.config import Config, ScenarioRow, parse, read_text
from neuspring.core.errors import InputError
from neuspring.data import capture
from neuspring.intake import phystwin
from neuspring.registry import Registry

if TYPE_CHECKING:
    from neuspring.core.artifacts import Observations


@dataclass(frozen=True, kw_only=True)
class Source:
    """A kind of data. Its module is imported on first use."""

    module: str
    """Name of the module that reads the data; Snakemake rules depend on the digest of its code."""
    reads: tuple[str, ...]
    """Keys of the configuration that reading depends on."""
    films: bool = False
    """True for raw video: perception makes observations from its capture."""
    write_capture: str = ""
    """Name of the module that writes captures. Empty: the user supplies the capture, or there are no images."""
    needs_data: bool = True
    """True if the data are below data_root."""
    has_truth: bool = False
    """True if each capture has a file with its truth."""
    own: bool = False
    """True for recordings of users: comparisons include methods that learn nothing, and tables contain cautions."""
    files: tuple[str, ...] = ()
    """Files of the scenario's folder from which observations are read; empty: the path itself."""
    needed: tuple[str, ...] = ()
    """Files of the scenario's folder without which no job can run; empty: the path itself."""
    remedy: str = "Correct data_root, or the scenario's name or path."
    """Next move for missing data, a format string with `data_root`."""
    capture_files: tuple[str, ...] = ()
    """Files of the scenario's folder, besides images, from which a capture is made."""
    images_beside: Callable[[Path], bool] = lambda folder: False
    """True if a folder of processed data also contains images, from which a capture for rendering can be made."""
    row_of: Callable[[str], ScenarioRow | None] = lambda name: None
    """Returns the row of a scenario that is in no table, if its name determines the row."""
    required: Callable[[Path], object] = lambda folder: None
    """Raises InputError if the folder lacks data that every run needs; reads only small files."""
    cameras: Callable[[Path, Config], tuple[str, ...]] = lambda folder, config: ()
    """Returns the names of the cameras before the capture is made. Raises InputError."""


def read_observations(row: ScenarioRow, settings: Config, output: Path) -> Observations:
    """Read the observations of a scenario without video. The truth of a toy scene is written next to `output`."""
    source = SOURCES[row.source]
    assert not source.films, f"{row.source} scenarios are video"
    observations: Observations = import_module(source.module).observe(row, location(row, settings), settings, output)
    return observations


def write_capture(row: ScenarioRow, settings: Config, folder: Path) -> None:
    """Write the capture folder of a scenario whose source creates captures. Raises InputError for other sources."""
    source = SOURCES[row.source]
    if not source.write_capture:
        makers = ", ".join(name for name, other in SOURCES.items() if other.write_capture)
        raise InputError(f"scenario {row.scenario}, source", f"captures are made only from {makers} scenarios", row.source)
    import_module(source.write_capture).write_capture(row, location(row, settings), settings, folder)


def location(row: ScenarioRow, settings: Config) -> Path:
    """The path of a scenario's data."""
    return Path(settings.data_root or ".") / row.path


def scenario_rows(settings: Config, root: Path = Path(), also: Iterable[str] = ()) -> dict[str, ScenarioRow]:
    """All scenarios, name -> row: those of the scenario table below `root`, and every other capture in `data_root`.

    A capture needs no row: its folder's name is the scenario, and capture.json contains the rest. Names in the configuration or
    `also` need no row if a source determines it from the name (`Source.row_of`). Raises InputError.
    """
    rows = read_scenarios(root / settings.scenario_table)
    groups = [*(settings.pools or {}).items(), *(settings.transfers or {}).items()]
    for name in dict.fromkeys([*settings.scenarios, *also, *(name for first, others in groups for name in (first, *others))]):
        if name not in rows and (found := next(filter(None, (source.row_of(name) for source in SOURCES.values())), None)):
            rows[name] = found
    for path in sorted(Path(settings.data_root).glob(f"*/{capture.CAPTURE}")) if settings.data_root else ():
        name = path.parent.name
        try:
            if name not in rows:
                rows[name] = row_of_capture(path)
        except InputError:
            # A damaged capture that is not selected must not stop the run.
            if name in settings.scenarios:
                raise
    return rows


def row_of_capture(path: Path) -> ScenarioRow:
    """The row of a capture that is not in the scenario table. Raises InputError."""
    description, name = capture.read_description(path), path.absolute().parent.name
    touches = description.category == "cloth" if description.self_collision is None else description.self_collision
    source = "capture" if description.cameras else "points"
    values = {"scenario": name, "source": source, "category": description.category, "path": name}
    return parse(ScenarioRow, values | {"self_collision": touches, "ground": description.ground}, str(path))


def read_scenarios(path: Path) -> dict[str, ScenarioRow]:
    """Read the scenario table (tab-separated, one header line, `#` comments): name -> row. Raises InputError."""
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    columns = [f.name for f in dataclasses.fields(ScenarioRow)]
    if not lines or lines[0].split("\t") != columns:
        raise InputError(path, f"the header must be the tab-separated columns {columns}", lines[:1])
    rows: dict[str, ScenarioRow] = {}
    for line in lines[1:]:
        cells = line.split("\t")
        where = f"{path}, row {cells[0]!r}"
        if len(cells) != len(columns):
            raise InputError(where, f"{len(columns)} tab-separated cells are required", len(cells))
        values: dict[str, Any] = dict(zip(columns, cells, strict=True))
        for flag in ("self_collision", "ground"):
            if values[flag] not in ("true", "false"):
                raise InputError(f"{where}, {flag}", "must be true or false", values[flag])
            values[flag] = values[flag] == "true"
        if cells[0] in rows:
            raise InputError(where, "scenario names must differ")
        row = parse(ScenarioRow, values, where)
        if row.source in SOURCES.left_out:
            continue
        if row.source not in SOURCES:
            raise InputError(f"{where}, source", f"must be one of {', '.join(SOURCES)}", repr(row.source))
        rows[cells[0]] = row
    return rows


def _required_capture(folder: Path) -> None:
    capture.require_finished(folder)
    if not (folder / capture.CAPTURE).exists():
        remedy = "Correct data_root or the path in the scenario table, or make a capture: `neuspring make-capture --help`."
        raise InputError(folder, "a capture must be a folder with capture.json", "a folder without it", remedy)
    if _filmed(folder) is False:
        raise InputError(folder, "the source capture requires video", "a capture without cameras", "Change the source to points.")
    if any((folder / name).exists() for name in IN_SPACE):
        _required_in_space(folder)


def _filmed(folder: Path) -> bool | None:
    """True if a capture has cameras; None if its description is unreadable, which the jobs of its scenario report."""
    try:
        return bool(capture.read_description(folder / capture.CAPTURE).cameras)
    except InputError:
        return None


def _required_points(folder: Path) -> None:
    if _filmed(folder):
        raise InputError(folder, "the source points is only for captures without cameras", "video", "Change the source to capture.")
    _required_in_space(folder)


def _required_in_space(folder: Path) -> None:
    from neuspring.intake.points import read

    read(capture.Capture.load(folder))


def _required_raw(folder: Path) -> None:
    from neuspring.intake.phystwin_raw import read_calibration

    read_calibration(folder)


def _counted(folder: Path, config: Config) -> tuple[str, ...]:
    return tuple(map(str, range(phystwin.camera_count(folder))))


IN_SPACE = (*capture.CONTROLLERS, *capture.NODES)
SOURCES = Registry(
    "sources",
    {
        "toy": Source(module="neuspring.scenes.toy", reads=("toy",), needs_data=False),
        "capture": Source(
            module="neuspring.data.capture",
            reads=("data_root",),
            films=True,
            own=True,
            required=_required_capture,
            cameras=lambda folder, config: tuple(c.name for c in capture.read_description(folder / capture.CAPTURE).cameras),
        ),
        "points": Source(
            module="neuspring.intake.points",
            reads=("data_root",),
            own=True,
            required=_required_points,
            files=(capture.CAPTURE, capture.TRACKS, *IN_SPACE),
        ),
        "phystwin_raw": Source(
            module="neuspring.intake.phystwin_raw",
            reads=("data_root",),
            films=True,
            write_capture="neuspring.intake.phystwin_raw",
            capture_files=phystwin.RAW_FILES,
            required=_required_raw,
            cameras=_counted,
        ),
        "phystwin": Source(
            module="neuspring.intake.phystwin",
            reads=("data_root",),
            write_capture="neuspring.intake.phystwin_raw",
            files=phystwin.FILES,
            needed=(phystwin.FINAL_DATA, phystwin.SPLIT),
            required=phystwin.split_and_rate,
            remedy="Run `neuspring fetch phystwin --data-root {data_root} --parts data results images`, or state the folder above "
            "data/different_types: --config data_root=...",
            capture_files=phystwin.RAW_FILES,
            images_beside=phystwin.has_images,
            cameras=_counted,
        ),
    },
    Source,
)
