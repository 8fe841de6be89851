"""Sources of scenarios: `SOURCES` declares every kind of data, and everybody asks it.

To add a source: a module that reads it, its line here, and rows of the scenario table; if it has settings, a section of
`neuspring.config.data`. A package adds one, a `Source`, by an entry point of the group `neuspring.sources`. Its module has

    observe(row, path, config, output) -> Observations     where it is not filmed; truth may be written beside `output`
    write_capture(row, path, config, folder)                where it is filmed, or has images beside processed data

with `path` where its data lie.
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
    """A kind of data. Its module is named, and imported when it is used."""

    module: str
    """Reads its data; rules carry the digest of this module's code."""
    reads: tuple[str, ...]
    """Keys of the configuration that reading depends on."""
    films: bool = False
    """Raw video: perception makes observations of its capture."""
    write_capture: str = ""
    """The module that writes its captures. None: the user supplies the capture, or there are no images."""
    needs_data: bool = True
    """True where it lies under data_root."""
    has_truth: bool = False
    """Its captures have the truth beside them."""
    own: bool = False
    """True for films of users: methods that learn nothing stand beside the others, and tables say what to be careful with."""
    files: tuple[str, ...] = ()
    """Files of its folder that observations are read from; none: the path itself."""
    needed: tuple[str, ...] = ()
    """Files of its folder without which no job can run; none: the path itself."""
    remedy: str = "Correct data_root, or the scenario's name or path."
    """The next move where data are not there, a format string over `data_root`."""
    capture_files: tuple[str, ...] = ()
    """Files of its folder that a capture is made from, beside images."""
    images_beside: Callable[[Path], bool] = lambda folder: False
    """True where images lie beside processed data, so that a capture can be made of them for pictures."""
    row_of: Callable[[str], ScenarioRow | None] = lambda name: None
    """The row of a scenario that no table has, where its name says all of it."""
    required: Callable[[Path], object] = lambda folder: None
    """Raises InputError where its folder lacks what no run can do without; it reads small files alone."""
    cameras: Callable[[Path, Config], tuple[str, ...]] = lambda folder, config: ()
    """Names of the cameras before the capture is made. Raises InputError."""


def read_observations(row: ScenarioRow, settings: Config, output: Path) -> Observations:
    """The observations of a scenario that is not filmed; the truth of a toy scene is written beside `output`."""
    source = SOURCES[row.source]
    assert not source.films, f"{row.source} scenarios are filmed"
    observations: Observations = import_module(source.module).observe(row, location(row, settings), settings, output)
    return observations


def write_capture(row: ScenarioRow, settings: Config, folder: Path) -> None:
    """A capture folder of a synthetic scene, or of PhysTwin's raw layout. Raises InputError for other sources."""
    source = SOURCES[row.source]
    if not source.write_capture:
        makers = ", ".join(name for name, other in SOURCES.items() if other.write_capture)
        raise InputError(f"scenario {row.scenario}, source", f"captures are made of {makers} scenarios", row.source)
    import_module(source.write_capture).write_capture(row, location(row, settings), settings, folder)


def location(row: ScenarioRow, settings: Config) -> Path:
    """The place where the data of a scenario lie."""
    return Path(settings.data_root or ".") / row.path


def scenario_rows(settings: Config, root: Path = Path(), also: Iterable[str] = ()) -> dict[str, ScenarioRow]:
    """All scenarios, name -> row: those of the table, which lies below `root`, and each capture in `data_root` that no row names.

    Such a capture needs no row: its folder is the scenario's name, and capture.json says the rest. What the configuration or `also`
    names needs none either, where a source knows the name (`Source.row_of`). Raises InputError.
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
            # Another capture that is damaged is no reason to stop.
            if name in settings.scenarios:
                raise
    return rows


def row_of_capture(path: Path) -> ScenarioRow:
    """The row that a capture.json stands for, where the table has none. Raises InputError."""
    own, name = capture.read_description(path), path.absolute().parent.name
    touches = own.category == "cloth" if own.self_collision is None else own.self_collision
    source = "capture" if own.cameras else "points"
    values = {"scenario": name, "source": source, "category": own.category, "path": name}
    return parse(ScenarioRow, values | {"self_collision": touches, "ground": own.ground}, str(path))


def read_scenarios(path: Path) -> dict[str, ScenarioRow]:
    """The scenario table (tab-separated, one header line, `#` comments): name -> row. Raises InputError."""
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
        remedy = "Correct the path in the scenario table, or data_root, or make a capture: `neuspring make-capture --help`."
        raise InputError(folder, "a capture is a folder with capture.json", "a folder without", remedy)
    if _filmed(folder) is False:
        raise InputError(folder, "the source capture is for film", "a capture without cameras", "Write points as its source.")
    if any((folder / name).exists() for name in IN_SPACE):
        _required_in_space(folder)


def _filmed(folder: Path) -> bool | None:
    """True where a capture has cameras; None where its description cannot be read, which the jobs of its scenario say."""
    try:
        return bool(capture.read_description(folder / capture.CAPTURE).cameras)
    except InputError:
        return None


def _required_points(folder: Path) -> None:
    if _filmed(folder):
        raise InputError(folder, "the source points is for captures without cameras", "a film", "Write capture as its source.")
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
            remedy="Bring them: `neuspring fetch phystwin --data-root {data_root} --parts data results images`; or name the folder "
            "above data/different_types: --config data_root=...",
            capture_files=phystwin.RAW_FILES,
            images_beside=phystwin.has_images,
            cameras=_counted,
        ),
    },
    Source,
)
