"""Sections of settings that packages register by entry points of the group `neuspring.settings`.

The name of an entry point is the dotted path of its section:

    [project.entry-points."neuspring.settings"]
    "baselines.mine" = "my_package.settings:Mine"
    "fit.mine" = "my_package.settings:MyFit"

`Mine` is a frozen dataclass that inherits `SettingsSection`. The package reads its section with `config.baselines.section(Mine)`.
Sections may be added to every dataclass that `with_extensions` decorates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from neuspring.core.section import SettingsSection
from neuspring.registry import Registry

T = TypeVar("T")
EXTENSION_SETTINGS = Registry[type[SettingsSection]]("settings", {}, type)
"""Dotted path of a section -> its dataclass."""


def with_extensions(path: str) -> Callable[[type[T]], type[T]]:
    """Decorator, below `dataclass`: add the sections that packages register at `path` (empty: the top level)."""

    def extended(kind: type[T]) -> type[T]:
        for name in EXTENSION_SETTINGS:
            above, _, key = name.rpartition(".")
            if above == path:
                kind.__annotations__[key] = EXTENSION_SETTINGS[name]
                setattr(kind, key, field(default_factory=EXTENSION_SETTINGS[name]))
        return kind

    return extended


@dataclass(frozen=True, kw_only=True)
@with_extensions("baselines")
class Baselines(SettingsSection):
    """Models of the baselines; a method's own `settings` override them."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...
