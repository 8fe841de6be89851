"""The command `twin`."""

from __future__ import annotations

from neuspring.extensions.own_video.options import Wish


def twin(wish: Wish) -> int:
    """Make a twin of your own video, with errors, a report and videos; rerun the same command to resume."""
    from neuspring.extensions.own_video.chain import TwinChain

    return TwinChain(wish).run()
