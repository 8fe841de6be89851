"""Settings of a sweep over settings."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field, StringConstraints

from neuspring.core.section import Count, Name, SettingsSection
from neuspring.core.text import refuse_password

Number = int | Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True, kw_only=True)
class Dimension(SettingsSection):
    """Values of one setting: numbers between `low` and `high`, or `choices`."""

    low: Number | None = None
    """Smallest value, in the setting's unit; a whole number where the setting is one."""
    high: Number | None = None
    """Largest value."""
    log: bool = False
    """Logarithmic scale of the draws."""
    step: Number | None = None
    """Distance between two values, from `low` on; null: 1 for whole numbers, otherwise continuous."""
    choices: tuple[Any, ...] = ()
    """Values to choose from instead of a range: any that the setting may have."""

    def __post_init__(self) -> None:
        if self.choices:
            if (self.low, self.high, self.log, self.step) != (None, None, False, None):
                raise ValueError("either choices or low and high (with log or step) are required, received both")
            if len(self.choices) < 2 or any(value in self.choices[:place] for place, value in enumerate(self.choices)):
                raise ValueError(f"choices: at least two, all different, are required, received {list(self.choices)}")
            return
        if self.low is None or self.high is None:
            raise ValueError("low and high, or choices, are required")
        wrong_step = self.step is not None and (self.log or not 0 < self.step <= self.high - self.low)
        if not self.low < self.high or (self.log and self.low <= 0) or wrong_step:
            rule = "low < high is required, for log low > 0 and no step, otherwise 0 < step <= high - low"
            raise ValueError(f"{rule}, received {self}")


@dataclass(frozen=True, kw_only=True)
class Tune(SettingsSection):
    """A sweep: which settings of one method are varied, and how trials are spent. Test frames are never read.

    The mean loss over the configuration's scenarios is minimized.
    """

    study: Annotated[Name, StringConstraints(max_length=60)]
    """Name of the sweep and of its folder in `<results>/tune`. A sweep keeps its method, space, settings and data for good."""
    method: Name
    """Row of the method table that is varied. Trial 0 is the row as it is, with its own settings and those of its search row."""
    space: dict[str, Dimension]
    """Setting -> values, see [tune.space](#tunespace). Keys are dotted paths of `simulation`, `losses`, `search`, `fit`,
    `released_quirks`, and `clusters`, the number of regions of the method's search."""
    trials: Count = 40
    """Number of trials over all workers: finished, pruned and failed ones. With a larger number the sweep continues."""
    workers: Count = 1
    """Number of jobs that share the sweep."""
    storage: str | None = None
    """PostgreSQL URI, for workers on several machines. It must hold no password: libpq reads PGPASSWORD or ~/.pgpass. null: SQLite
    in the sweep's folder, for workers of one machine."""

    def __post_init__(self) -> None:
        if not self.space:
            raise ValueError("space: at least one setting is required")
        if self.storage:
            if not re.fullmatch(r"postgresql(\+\w+)?://\S+", self.storage):
                rule = "must be postgresql://HOST/DATABASE, or null: SQLite in the sweep's folder, for workers of one machine"
                raise ValueError(f"storage: {rule}; received {self.storage!r}")
            refuse_password("storage", self.storage, "PGPASSWORD or ~/.pgpass")
