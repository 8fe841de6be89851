"""NeuSpring: spring-mass twins of deformable objects from RGBD video, with a Snakemake workflow.

The functions and classes of `neuspring.api` are also available here; they are imported on first use.
"""

from typing import TYPE_CHECKING, Any

from neuspring.core.version import __version__ as __version__

if TYPE_CHECKING:
    from neuspring.api import (
        Observations,
        Topology,
        Trajectory,
        Twin,
        fit,
        load_run,
        move,
        roll_out,
        sample_twin,
        score,
        search,
        show,
        twin_from_capture,
        with_mass,
    )

__all__ = [
    "Observations", "Topology", "Trajectory", "Twin",
    "fit", "load_run", "move", "roll_out", "sample_twin", "score", "search", "show", "twin_from_capture", "with_mass",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from neuspring import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
