"""The types of which settings are made: strict (no casts, no unknown keys) and bounded.

They stand below `neuspring.config`, because the settings of a baseline are declared where its code is, and the configuration takes
them from there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import ConfigDict, Field, StringConstraints

S = TypeVar("S")
STRICT = ConfigDict(extra="forbid", strict=True)
"""No unknown keys, no casts."""
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,79}$")]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Range = tuple[Finite, Finite]


class SettingsSection:
    """Base of the dataclasses of settings."""

    __pydantic_config__ = STRICT
    efforts: ClassVar[dict[str, tuple[Any, Any, Any]]] = {}
    """Key -> its value at each effort (quick, normal, paper), for a section that a package brings."""

    def section(self, kind: type[S]) -> S:
        """The section of this type. Raises LookupError."""
        for value in vars(self).values():
            if isinstance(value, kind):
                return value
        raise LookupError(f"{type(self).__name__} has no section {kind.__name__}")

    def expand(self, config: S) -> S:
        """The configuration with what this section of it stands for, of a section at its top level. Raises InputError."""
        return config

    @classmethod
    def completed(cls, given: Mapping[str, Any]) -> Mapping[str, Any]:
        """The given values, with those that follow from them."""
        return given
