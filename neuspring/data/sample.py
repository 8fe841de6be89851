"""The sample twin of the package, in the folder layout of a run."""

from pathlib import Path


def sample_twin() -> Path:
    """Return the folder of a fitted run on the demo's plush sloth: synthetic, 45 frames, with observations and splats.

    Every command that takes `results/<scenario>/<method>/<seed>` accepts it. `make sample` creates it again; its run.json contains
    the commit.
    """
    return Path(__file__).with_name("sample_twin") / "synthetic_single_lift_sloth" / "neuspring" / "0"
