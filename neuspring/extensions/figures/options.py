"""Options of the commands that draw runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from neuspring.cli.options import Device, Positional, arg

README_FILM_MEGABYTES = 2.0
"""Default file size, MB: small enough for a README."""


@dataclass(kw_only=True)
class RunOptions:
    """Options for the runs, the view and the output file."""

    results: Annotated[
        Positional[tuple[Path, ...]], arg(help="results/<scenario>, or runs <scenario>/<method>/<seed> of one scenario")
    ]
    methods: Annotated[tuple[str, ...], arg(help="METHOD or METHOD/SEED, in the order of the figure")] = ()
    labels: Annotated[tuple[str, ...], arg(help="names in the figure, one per method")] = ()
    camera: Annotated[str | None, arg(help="camera of the capture; default: the first, or without cameras the broad side")] = None
    azimuth: Annotated[float | None, arg(help="free view instead of a camera: degrees around the vertical axis from +x")] = None
    elevation: Annotated[float | None, arg(help="free view: degrees above the horizon; default 25")] = None
    device: Device = "auto"
    output: Annotated[Path, arg(help="output file, for example figure.pdf or video.gif")]


@dataclass(kw_only=True)
class ComparedOptions(RunOptions):
    """Options for predictions and errors."""

    frames: Annotated[tuple[int, ...], arg(help="default of a strip: first, last training, middle of the future, last")] = ()
    style: Annotated[Literal["splats", "nodes"] | None, arg(name="as", help="default: splats if all runs have them")] = None
    error: Annotated[
        Literal["best", "color", "distance", "none"],
        arg(help="color difference, distance of nodes to observed points, or none; best: color if possible"),
    ] = "best"
    most: Annotated[float | None, arg(help="upper end of the errors: difference of colors from 0 to 1, or mm for distance")] = None


Inches = Annotated[float, arg(help="inches on paper; text has 8 points")]
Dots = Annotated[float, arg(help="dots per inch of photos and splats")]


@dataclass(kw_only=True)
class StripOptions(ComparedOptions):
    """Options for the size on paper."""

    width: Inches = 7.0
    dpi: Dots = 300.0


@dataclass(kw_only=True)
class FilmOptions(ComparedOptions):
    """Options for the size of a video."""

    width: Annotated[int, arg(help="px")] = 800
    megabytes: Annotated[float, arg(help="largest file size; resolution is reduced to fit")] = README_FILM_MEGABYTES


@dataclass(kw_only=True)
class TwinOptions(RunOptions):
    """Options for the content of a figure of twins and its size on paper."""

    by: Annotated[tuple[Literal["stiffness", "region"], ...], arg(help="rows: springs by stiffness, nodes by region")] = (
        "stiffness",
        "region",
    )
    frame: Annotated[int, arg(help="frame of the prediction")] = 0
    style: Annotated[Literal["springs", "splats"], arg(name="as", help="springs as lines, or the surface as splats")] = "springs"
    width: Inches = 7.0
    dpi: Dots = 300.0
