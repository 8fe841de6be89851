"""Options of the commands that draw runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from neuspring.cli.options import Device, Positional, arg

README_FILM_MEGABYTES = 2.0
"""Size of a film that a README loads at once."""


@dataclass(kw_only=True)
class RunOptions:
    """Runs to draw, the view, and the file."""

    results: Annotated[
        Positional[tuple[Path, ...]], arg(help="results/<scenario>, or runs <scenario>/<method>/<seed> of one scenario")
    ]
    methods: Annotated[tuple[str, ...], arg(help="METHOD or METHOD/SEED, in the order of the picture")] = ()
    labels: Annotated[tuple[str, ...], arg(help="names in the picture, one per method")] = ()
    camera: Annotated[str | None, arg(help="a camera of the capture; the first by default, or a view of the broad side")] = None
    azimuth: Annotated[float | None, arg(help="instead of a camera: degrees around the vertical axis, 0 from +x")] = None
    elevation: Annotated[float | None, arg(help="degrees above the horizon; 25 by default")] = None
    device: Device = "auto"
    output: Annotated[Path, arg(help="file to write, for example picture.pdf or film.gif")]


@dataclass(kw_only=True)
class ComparedOptions(RunOptions):
    """Look of predictions and errors."""

    frames: Annotated[tuple[int, ...], arg(help="of a strip: first, last of training, middle of the future, last by default")] = ()
    style: Annotated[Literal["splats", "nodes"] | None, arg(name="as", help="splats where the runs have them by default")] = None
    error: Annotated[
        Literal["best", "color", "distance", "none"],
        arg(help="difference of pictures, distance of nodes to observed points, or no errors; best: what can be drawn"),
    ] = "best"
    most: Annotated[float | None, arg(help="upper end of the range of errors: of 1 for color, mm for distance")] = None


Inches = Annotated[float, arg(help="inches on paper, where text has 8 points")]
Dots = Annotated[float, arg(help="dots per inch of what is not lines or text")]


@dataclass(kw_only=True)
class StripOptions(ComparedOptions):
    """The size on paper."""

    width: Inches = 7.0
    dpi: Dots = 300.0


@dataclass(kw_only=True)
class FilmOptions(ComparedOptions):
    """The size."""

    width: Annotated[int, arg(help="pixels")] = 800
    megabytes: Annotated[float, arg(help="largest file; a film beyond it is made coarser")] = README_FILM_MEGABYTES


@dataclass(kw_only=True)
class TwinOptions(RunOptions):
    """Parts of twins that are drawn, and the size on paper."""

    by: Annotated[tuple[Literal["stiffness", "region"], ...], arg(help="rows: springs by stiffness, nodes by region")] = (
        "stiffness",
        "region",
    )
    frame: Annotated[int, arg(help="of the prediction")] = 0
    style: Annotated[Literal["springs", "splats"], arg(name="as", help="springs as lines, or the surface that splats show")] = (
        "springs"
    )
    width: Inches = 7.0
    dpi: Dots = 300.0
