"""The small twin that travels with the package, in the form in which the workflow leaves a run."""

from pathlib import Path


def sample_twin() -> Path:
    """The folder of a fitted run of the demo's plush sloth: synthetic, 45 frames, with its observations and splats.

    It serves whatever takes `results/<scenario>/<method>/<seed>`. `make sample` makes it again; its run.json names the commit.
    """
    return Path(__file__).with_name("sample_twin") / "synthetic_single_lift_sloth" / "neuspring" / "0"
