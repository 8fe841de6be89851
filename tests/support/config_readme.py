"""Writes config/README.md from the configuration's own declarations: python -m tests.support.config_readme"""

import ast
import dataclasses
import types
import typing
from pathlib import Path
from typing import Any

from pydantic.fields import FieldInfo

from neuspring import config
from neuspring.config import baselines as config_baselines
from neuspring.config import gpus as config_gpus
from neuspring.config import gs_dynamics as config_gs_dynamics
from neuspring.config import images as config_images
from neuspring.config import perception as config_perception
from neuspring.config import spring_gaus as config_spring_gaus
from neuspring.config import tuning as config_tune

ROOT = Path(__file__).parents[2]
INTRODUCTION = """# Configuration

`config.yaml` is the default (the demo) and always read first. Overlays merge on top of it, later ones win; nested keys are
set in an overlay:

```
snakemake --profile workflow/profiles/default --cores 2 --quiet rules \\
  --configfile config/mocap.yaml --config data_root=/path/to/data_set
```

The "default" column below is the program's: what holds where neither `config.yaml` nor an overlay sets a key. `config.yaml` sets
`synthetic`, `perception`, `images.appearance`, `search.rollouts`, `search.start`, `fit.epochs` and `baselines` for its scenes, so
overlays for other data set them anew. `--config` on the command line is for single values and lists of names at the top level;
Snakemake hands numbers in lists over as text, which is refused, so `seeds` and nested keys are set in an overlay.

| overlays, in this order | what they measure |
|---|---|
| `mocap.yaml` | cables under motion capture, the ablations and `neuspring_plus`, three seeds, transfers |
| `mocap.yaml`, `mocap_first_frame.yaml` | the same with the rest shape of frame 0, as in the paper, and 220 rollouts |
| `mocap.yaml`, `mocap_free.yaml` | regions that are free from the search's first rollout, as in the paper |
| `mocap.yaml`, `mocap_pieces.yaml` | each piece of `neuspring_plus` alone |
| `mocap.yaml`, `mocap_field.yaml` | where the Fourier transform stands, how fast the planes learn |
| `mocap.yaml`, `mocap_prediction.yaml` | correcting the state at the last training frame; averages over seeds |
| `mocap.yaml`, `mocap_fine.yaml` | two recordings at 50 Hz with twice the rings |
| `mocap.yaml`, `mocap_eval.yaml` | twins fitted on the six evaluation recordings |
| `toy.yaml` | three toy scenes without images, the smallest run |
| `synthetic.yaml` | the 22 synthetic scenes at full length, three seeds; alone it is the whole benchmark from raw video |
| `perception.yaml`; then `clean_depth.yaml` | errors of perception, one scene per category; with a depth camera without flaws |
| `true_observations.yaml` | the demo's scenes observed perfectly |
| `raw.yaml` | your own RGBD video, or PhysTwin's raw layout, with the networks and settings of the released processing |
| `heldout.yaml` | four scenes moved by another engine |
| `baselines.yaml`, alone or behind `synthetic.yaml`, `mocap.yaml`, `toy.yaml` | every system of the paper's Table 1 |
| `clusters.yaml`, alone or after `mocap.yaml` | 1 to 10 regions |
| `benchmark.yaml` | the whole benchmark: the 22 released scenarios, every method and study of the paper, three seeds |
| ..., `paper.yaml` | the same methods and studies on other data: behind `toy.yaml`, `synthetic.yaml` or `mocap.yaml` |
| ..., `one_seed.yaml` | seed 0 of any of them, no transfers |
| `three_seeds.yaml` | the demo with three seeds |

Everything is checked before the first job: unknown keys, wrong types (YAML reads `5e-5` as text: write `5.0e-5`), unknown
scenarios, methods and searches, missing data, a results folder that cannot be written. Values are never cast.

- `scenarios.tsv`: one row per capture (toy scenes, motion capture, the 22 PhysTwin scenarios).
- `methods.yaml`: one row per method: the search it starts from, the stage that follows, its own `fit` settings; or the model of a
  baseline and its own settings of `baselines`.
- `searches.yaml`: one row per search: into how many regions the topology is divided (`clusters`), its own `search` settings.
- Threads, cores and executors are not configuration: they live on the command line and in `workflow/profiles/`.

This page is written from `neuspring/config*.py` by `python -m tests.support.config_readme`; a test keeps them equal.
"""
KEYS = {
    "(top level)": config.Config,
    "gpus": config_gpus.Gpus,
    "simulation": config.Simulation,
    "losses": config.Losses,
    "search": config.Search,
    "search.clusters": config.Clusters,
    "search.ranges": config.SearchRanges,
    "search.start": config.SearchStart,
    "fit": config.Fit,
    "fit.field": config.SpringField,
    "released_quirks": config.ReleasedQuirks,
    "toy": config.Toy,
    "mocap": config.Mocap,
    "synthetic": config_perception.Synthetic,
    "perception": config_perception.Perception,
    "perception.segment": config_perception.Segmentation,
    "perception.segment.opencv": config_perception.OpenCvSegmentation,
    "perception.segment.grounded_sam2": config_perception.GroundedSam2,
    "perception.track": config_perception.PointTracking,
    "perception.track.opencv": config_perception.OpenCvTracking,
    "perception.track.cotracker3": config_perception.CoTracker3,
    "perception.lift": config_perception.Lift,
    "perception.shape": config_perception.ShapePriorSettings,
    "perception.sample": config_perception.Sampling,
    "images": config_images.Images,
    "images.appearance": config_images.Appearance,
    "images.lpips": config_images.LpipsWeights,
    "images.released_quirks": config_images.ImageQuirks,
    "baselines": config_baselines.Baselines,
    "baselines.spring_gaus": config_spring_gaus.SpringGaus,
    "baselines.gs_dynamics": config_gs_dynamics.GsDynamics,
    "tracking": config.Tracking,
    "tune": config_tune.Tune,
    "tune.space": config_tune.Dimension,
}
ROWS = {"rows of methods.yaml": config.Method, "rows of searches.yaml": config.SearchRow}
MEANINGS = {"description": "What the row is, for people."}
"""Of keys that explain themselves in the code."""
BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
PLAIN = {int: "integer", float: "number", str: "text", bool: "`true`, `false`", types.NoneType: "`null`", Any: "any"}


def text() -> str:
    """The page."""
    parts = [INTRODUCTION, "## Keys\n"]
    parts += [section(title, kind) for title, kind in KEYS.items()]
    parts += ["## Tables\n"]
    parts += [section(title, kind) for title, kind in ROWS.items()]
    return "\n".join(parts)


def section(title: str, kind: type) -> str:
    """A heading, what the section is, and a table of its keys."""
    summary = (kind.__doc__ or "").partition("\n")[0]
    rows = ["| key | allowed | default | meaning |", "|---|---|---|---|"]
    rows += [f"| `{key}` | {allowed} | {default} | {meaning} |" for key, allowed, default, meaning in fields(kind)]
    return "\n".join([f"### {title}", "", summary, "", *rows, ""])


def fields(kind: type) -> list[tuple[str, str, str, str]]:
    """(key, allowed, default, meaning) of every field; the meaning is the text below its declaration."""
    hints, meanings = typing.get_type_hints(kind, include_extras=True), declared_meanings(kind)
    found = []
    for spec in dataclasses.fields(kind):
        is_section = dataclasses.is_dataclass(hints[spec.name])
        default = "" if is_section else shown_default(spec)
        meaning = meanings.get(spec.name) or MEANINGS.get(spec.name, "")
        found.append((spec.name, "section" if is_section else allowed(hints[spec.name]), default, meaning))
    return found


def declared_meanings(kind: type) -> dict[str, str]:
    """Key -> the text below its declaration in the class's module."""
    tree = ast.parse((ROOT / f"{kind.__module__.replace('.', '/')}.py").read_text())
    node = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == kind.__name__)
    found = {}
    for statement, after in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            found[statement.target.id] = " ".join(str(after.value.value).split()) if is_text else ""
    return found


def shown_default(spec: dataclasses.Field) -> str:
    """As one would write it in YAML."""
    if spec.default_factory is not dataclasses.MISSING:
        return f"`{yaml_text(spec.default_factory())}`"
    return "required" if spec.default is dataclasses.MISSING else f"`{yaml_text(spec.default)}`"


def yaml_text(value: Any) -> str:
    """A plain value in YAML's flow style; floats with a point, as the strict reader wants them."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, tuple):
        return f"[{', '.join(map(yaml_text, value))}]"
    if value == "":
        return '""'
    # Six digits: 1/6 is meant, not its last bit.
    return repr(float(f"{value:.6g}")) if isinstance(value, float) else str(value)


def allowed(hint: Any) -> str:
    """Type and range of a key in words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        limits = " and ".join(filter(None, map(limit, bounds(hint))))
        return f"{allowed(arguments[0])} {limits}".rstrip()
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(allowed, arguments))
    if origin is typing.Literal:
        return ", ".join(f"`{word}`" for word in arguments)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"list of {allowed(arguments[0])}"
        return f"[{', '.join(map(allowed, arguments))}]"
    if dataclasses.is_dataclass(hint):
        return "section"
    return "mapping" if origin is dict else PLAIN[hint]


def bounds(hint: Any) -> list[Any]:
    """Single constraints of an annotated type."""
    found = []
    for item in hint.__metadata__:
        found += item.metadata if isinstance(item, FieldInfo) else [item]
    return found


def limit(constraint: Any) -> str:
    """One constraint in words; empty for those that say nothing to a reader (patterns, finiteness)."""
    return " and ".join(f"{sign} {getattr(constraint, name):g}" for name, sign in BOUNDS.items() if hasattr(constraint, name))


if __name__ == "__main__":
    (ROOT / "config" / "README.md").write_text(text())
