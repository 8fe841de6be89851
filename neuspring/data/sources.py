"""Where scenarios come from: `SOURCES` declares every kind of data, and the workflow asks it.

To add a source: a reader (`observations`) or an importer to the capture format (`write_capture`), and its line here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuspring.config import Config, ScenarioRow, parse, read_text
from neuspring.core.errors import InputError
from neuspring.data import capture, phystwin

if TYPE_CHECKING:
    from neuspring.core.artifacts import Observations


@dataclass(frozen=True, kw_only=True)
class Source:
    """A kind of data. Modules are named, and imported when they are used."""

    module: str
    """Reads its data; rules carry the digest of this module's code."""
    reads: tuple[str, ...]
    """Keys of the configuration that reading depends on."""
    films: bool = False
    """Raw video: perception makes observations of its capture."""
    observations: Callable[[Any, ScenarioRow, Config, Path], Observations] | None = None
    """(module, row, settings, output) -> observations, of sources that are not filmed."""
    write_capture: Callable[[Any, ScenarioRow, Config, Path], None] | None = None
    """(module, row, settings, folder): write a capture folder. None if the user supplies the capture, or there are no images."""
    capture_module: str = ""
    """Writes captures, where that is another module."""
    needs_data: bool = True
    """Whether it lies under data_root."""
    has_truth: bool = False
    """Its captures have the truth beside them."""
    own: bool = False
    """What users film: methods that learn nothing always stand beside the others, and tables say what to be careful with."""
    files: tuple[str, ...] = ()
    """Files of its folder that observations are read from; none: the path itself."""
    capture_files: tuple[str, ...] = ()
    """Files of its folder that a capture is made from, beside images."""
    images_beside: Callable[[Path], bool] = lambda folder: False
    """Whether images lie beside processed data, so that a capture can be made of them for pictures."""
    required: Callable[[Path], None] = lambda folder: None
    """Raises InputError where its folder lacks what no run can do without."""
    cameras: Callable[[Path, Config], tuple[str, ...]] = lambda folder, config: ()
    """Names of the cameras before the capture is made. Raises InputError."""

    @property
    def importer(self) -> str:
        """The module that writes its captures."""
        return self.capture_module or self.module


def read_observations(row: ScenarioRow, settings: Config, output: Path) -> Observations:
    """The observations of a scenario that is not filmed; the truth of a toy scene is written beside `output`."""
    source = SOURCES[row.source]
    assert source.observations, f"{row.source} scenarios are filmed"
    return source.observations(import_module(source.module), row, settings, output)


def write_capture(row: ScenarioRow, settings: Config, folder: Path) -> None:
    """A capture folder of a synthetic scene, or of PhysTwin's raw layout. Raises InputError for other sources."""
    source = SOURCES[row.source]
    if source.write_capture is None:
        makers = ", ".join(name for name, other in SOURCES.items() if other.write_capture)
        raise InputError(f"scenario {row.scenario}, source", f"captures are made of {makers} scenarios", row.source)
    source.write_capture(import_module(source.importer), row, settings, folder)


def location(row: ScenarioRow, settings: Config) -> Path:
    """Where the data of a scenario lie."""
    return Path(settings.data_root or ".") / row.path


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
        if row.source not in SOURCES:
            raise InputError(f"{where}, source", f"must be one of {', '.join(SOURCES)}", repr(row.source))
        rows[cells[0]] = row
    return rows


def _toy(module: Any, row: ScenarioRow, settings: Config, output: Path) -> Observations:
    scene = module.make(row, settings.toy)
    # Never read by a method.
    scene.truth.save(output.with_name("truth.npz"))
    observations: Observations = scene.observations
    return observations


def _mocap(module: Any, row: ScenarioRow, settings: Config, output: Path) -> Observations:
    observations: Observations = module.read(row, location(row, settings), settings.mocap)
    return observations


def _phystwin(module: Any, row: ScenarioRow, settings: Config, output: Path) -> Observations:
    observations: Observations = module.read(row, location(row, settings))
    return observations


def _synthetic_capture(module: Any, row: ScenarioRow, settings: Config, folder: Path) -> None:
    _, truth = module.make(row, settings.synthetic, folder)
    moved = f"{1e3 * truth.certificate:.2g} mm by twice as many, {1e3 * truth.sensitivity:.2g} mm by a start 1 um off"
    energy = truth.kinetic[-1] + truth.potential[-1]
    print(f"{row.scenario}: {truth.substeps} substeps per frame; mean node moved {moved}", flush=True)
    print(f"{row.scenario}: smallest det F {truth.least_jacobian.min():.2f}; energy at the end {energy:.3f} J", flush=True)


def _phystwin_capture(module: Any, row: ScenarioRow, settings: Config, folder: Path) -> None:
    module.convert(row, location(row, settings), folder)


def _required_capture(folder: Path) -> None:
    if not (folder / capture.CAPTURE).exists():
        remedy = "Correct the path in the scenario table, or data_root, or make a capture: `neuspring make-capture --help`."
        raise InputError(folder, "a capture is a folder with capture.json", "a folder without", remedy)


def _counted(folder: Path, config: Config) -> tuple[str, ...]:
    return tuple(map(str, range(phystwin.camera_count(folder))))


def _described(folder: Path, config: Config) -> tuple[str, ...]:
    return tuple(camera.name for camera in capture.read_description(folder / capture.CAPTURE).cameras)


SOURCES = {
    "toy": Source(
        module="neuspring.data.synthetic.toy",
        reads=("toy",),
        observations=_toy,
        needs_data=False,
    ),
    "mocap": Source(
        module="neuspring.data.mocap",
        reads=("data_root", "mocap"),
        observations=_mocap,
    ),
    "synthetic": Source(
        module="neuspring.data.synthetic.make",
        reads=("synthetic",),
        films=True,
        write_capture=_synthetic_capture,
        needs_data=False,
        has_truth=True,
        cameras=lambda folder, config: tuple(map(str, range(config.synthetic.cameras))),
    ),
    "capture": Source(
        module="neuspring.data.capture",
        reads=("data_root",),
        films=True,
        own=True,
        required=_required_capture,
        cameras=_described,
    ),
    "phystwin_raw": Source(
        module="neuspring.data.phystwin",
        reads=("data_root",),
        films=True,
        write_capture=_phystwin_capture,
        capture_files=phystwin.RAW_FILES,
        cameras=_counted,
    ),
    "phystwin": Source(
        module="neuspring.data.phystwin",
        reads=("data_root",),
        observations=_phystwin,
        files=phystwin.FILES,
        write_capture=_phystwin_capture,
        capture_files=phystwin.RAW_FILES,
        images_beside=phystwin.has_images,
        cameras=_counted,
    ),
}
