"""Settings of the baseline models, which learn or need no spring-mass twin: `model` of a method row names one.

Each package that brings a baseline brings its section too, by an entry point of the group `neuspring.baseline_settings`.
"""

from __future__ import annotations

from dataclasses import field, make_dataclass
from typing import TYPE_CHECKING, Any

from neuspring.core.section import SettingsSection
from neuspring.registry import Registry

BASELINE_SETTINGS = Registry[type[SettingsSection]]("baseline_settings", {}, type)
"""Name of a section -> its dataclass."""

if TYPE_CHECKING:
    Baselines = Any
else:
    Baselines = make_dataclass(
        "Baselines",
        [(name, kind, field(default_factory=kind)) for name, kind in BASELINE_SETTINGS.items()],
        bases=(SettingsSection,),
        namespace={"__doc__": "The models of the baselines; a method's own `settings` go on top.", "__module__": __name__},
        frozen=True,
        kw_only=True,
    )
