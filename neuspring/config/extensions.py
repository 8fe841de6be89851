"""Sections of settings that packages bring, by an entry point of the group `neuspring.settings`.

The name of an entry point is the dotted path of its section:

    [project.entry-points."neuspring.settings"]
    "baselines.mine" = "my_package.settings:Mine"
    "fit.mine" = "my_package.settings:MyFit"

`Mine` is a frozen dataclass above `SettingsSection`. Code of the package reads its section, typed, by
`config.baselines.section(Mine)`. A section may be added to each dataclass that `with_extensions` decorates.
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
    """Decorate a section, below its `dataclass`: it gets the sections that packages bring at `path` (empty: the top level)."""

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
    """The models of the baselines; a method's own `settings` go on top."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...
