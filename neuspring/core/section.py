"""Types of settings: strict (no casts, no unknown keys) and bounded.

They are not in `neuspring.config`, because that package imports the settings of baselines, which use these types.
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
    """Base class of all sections of settings."""

    __pydantic_config__ = STRICT
    efforts: ClassVar[dict[str, tuple[Any, Any, Any]]] = {}
    """Key -> its value at each effort (quick, normal, paper), for sections of packages."""

    def section(self, kind: type[S]) -> S:
        """The subsection of this type. Raises LookupError."""
        for value in vars(self).values():
            if isinstance(value, kind):
                return value
        raise LookupError(f"{type(self).__name__} has no section {kind.__name__}")

    def expand(self, config: S) -> S:
        """Expand a top-level section: the configuration with the scenarios, pools and transfers that it implies.

        Raises InputError.
        """
        return config

    @classmethod
    def completed(cls, given: Mapping[str, Any]) -> Mapping[str, Any]:
        """The given values, with values derived from them."""
        return given
