"""The command `twin`."""

from __future__ import annotations

from neuspring.extensions.own_video.options import Wish


def twin(wish: Wish) -> int:
    """A film of your own -> its twin, errors, a page and films. The same command goes on where it was stopped."""
    from neuspring.extensions.own_video.chain import TwinChain

    return TwinChain(wish).run()
