"""The command draw: film strips, twins and films of finished runs for papers, and single frames of splats."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from neuspring.cli import options as shared

KINDS = {
    "strip": "observed frames on top, each method's prediction and error below -> PDF or PNG",
    "twin": "stiffness and regions of twins, from any side -> PDF or PNG",
    "film": "observed beside predicted, moving -> MP4 or GIF of limited size",
    "frames": "splats and trajectory -> RGBA pictures of any camera",
}
MEGABYTES = 2.0
"""Size of a film that a README loads at once."""


def words(given: list[str]) -> list[str]:
    """The words of a command line, with the kind of picture named: options alone draw frames, as before there were others."""
    bare = given[:1] == ["draw"] and len(given) > 1 and given[1].startswith("-") and given[1] not in ("-h", "--help")
    return ["draw", "frames", *given[1:]] if bare else given


def draw_options(parser: ArgumentParser) -> None:
    """Add the kinds of pictures and their options."""
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="kind")
    parts = {name: kinds.add_parser(name, help=about, description=about) for name, about in KINDS.items()}
    _frames(parts["frames"])
    _runs(parts["strip"], "pdf")
    parts["strip"].add_argument(
        "--frames", type=int, nargs="+", help="default: first, last of training, middle of the future, last"
    )
    _compared(parts["strip"], error="color for splats, distance for nodes")
    _page(parts["strip"])
    _runs(parts["twin"], "pdf")
    about = "rows: springs by stiffness, nodes by region; default: both"
    parts["twin"].add_argument("--by", nargs="+", choices=("stiffness", "region"), default=["stiffness", "region"], help=about)
    parts["twin"].add_argument("--frame", type=int, default=0, help="of the prediction; default: 0")
    about = "springs as lines, or the surface that splats show; default: springs"
    parts["twin"].add_argument("--as", dest="style", choices=("springs", "splats"), default="springs", help=about)
    about = "what is behind: white paper, or the photo, pale; default: white"
    parts["twin"].add_argument("--background", choices=("white", "image"), default="white", help=about)
    _page(parts["twin"])
    _runs(parts["film"], "gif")
    parts["film"].add_argument("--frames", type=int, nargs="+", help="default: all")
    _compared(parts["film"], error="none")
    parts["film"].add_argument("--width", type=int, default=800, metavar="PIXELS", help="default: 800")
    parts["film"].add_argument("--speed", type=float, default=1.0, help="1: as fast as it was; 0.5: half as fast")
    about = f"largest file; a film beyond it is made coarser; default: {MEGABYTES:g}"
    parts["film"].add_argument("--megabytes", type=float, default=MEGABYTES, help=about)


def _frames(parser: ArgumentParser) -> None:
    """A prediction's splats, seen by a camera."""
    parser.add_argument("--capture", type=Path, required=True, help="capture.json")
    shared.add_record(parser, "appearance", "appearance.json")
    shared.add_record(parser, "rollout", "rollout.json")
    parser.add_argument("--camera", required=True)
    parser.add_argument("--frames", type=int, nargs="+", help="all by default")
    parser.add_argument("--background", choices=("black", "white"), default="black")
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser, "folder to write to")


def _runs(parser: ArgumentParser, ending: str) -> None:
    """Which runs, seen from where, as which file."""
    about = "results/<scenario>, or runs <scenario>/<method>/<seed> of one scenario"
    parser.add_argument("results", type=Path, nargs="+", help=about)
    parser.add_argument("--methods", nargs="+", metavar="METHOD", help="METHOD or METHOD/SEED, in the order of the picture")
    parser.add_argument("--labels", nargs="+", metavar="TEXT", help="names in the picture, one per method")
    parser.add_argument("--camera", help="a camera of the capture; default: the first, or a view of the broad side")
    parser.add_argument("--azimuth", type=float, help="instead of a camera: degrees around the vertical axis, 0 from +x")
    parser.add_argument("--elevation", type=float, help="degrees above the horizon; default: 25")
    shared.add_settings(parser)
    shared.add_device(parser)
    shared.add_output(parser, f"file to write, for example picture.{ending}")


def _compared(parser: ArgumentParser, error: str) -> None:
    """How predictions and errors are drawn."""
    about = "default: splats where the runs have them"
    parser.add_argument("--as", dest="style", choices=("splats", "nodes"), help=about)
    about = f"difference of pictures, distance of nodes to observed points, or no errors; default: {error}"
    parser.add_argument("--error", choices=("color", "distance", "none"), help=about)
    parser.add_argument("--most", type=float, help="upper end of the range of errors: of 1 for color, mm for distance")
    about = "white paper, or the photo (pale behind a prediction); default: white for splats, image for nodes"
    parser.add_argument("--background", choices=("white", "image"), help=about)


def _page(parser: ArgumentParser) -> None:
    """The size on paper."""
    parser.add_argument("--width", type=float, default=7.0, metavar="INCHES", help="on paper, where text has 8 points; default: 7")
    parser.add_argument("--dpi", type=float, default=300.0, help="dots per inch of what is not lines or text; default: 300")


def draw(a: Namespace) -> None:
    """`neuspring draw`."""
    if a.kind == "frames":
        from neuspring.core.records import Before
        from neuspring.stages.render import draw_frames

        records = (Before.load(a.appearance), Before.load(a.rollout))
        settings = shared.read_settings(a.settings)
        made = draw_frames(a.capture.parent, *records, a.camera, a.frames, a.background, settings, a.device, a.output)
        print(f"{len(made)} pictures: {a.output}")
        return
    from neuspring.cli import pictures

    {"strip": pictures.strip, "twin": pictures.twin, "film": pictures.film}[a.kind](a)
