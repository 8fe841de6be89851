"""Settings of a sweep: the method, its varied settings, and the number of trials."""

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
    """Values of one setting: a range from `low` to `high`, or `choices`."""

    low: Number | None = None
    """Smallest value, in the setting's unit; an integer for an integer setting."""
    high: Number | None = None
    """Largest value."""
    log: bool = False
    """Sample on a logarithmic scale."""
    step: Number | None = None
    """Step from `low`; null: 1 for integers, otherwise continuous."""
    choices: tuple[Any, ...] = ()
    """List of values instead of a range."""

    def __post_init__(self) -> None:
        if self.choices:
            if (self.low, self.high, self.log, self.step) != (None, None, False, None):
                raise ValueError("either choices, or low and high (with log or step) are required, received both")
            if len(self.choices) < 2 or any(value in self.choices[:index] for index, value in enumerate(self.choices)):
                raise ValueError(f"choices: at least two different values are required, received {list(self.choices)}")
            return
        if self.low is None or self.high is None:
            raise ValueError("low and high, or choices, are required")
        wrong_step = self.step is not None and (self.log or not 0 < self.step <= self.high - self.low)
        if not self.low < self.high or (self.log and self.low <= 0) or wrong_step:
            rule = "low < high is required; with log also low > 0 and no step, otherwise 0 < step <= high - low"
            raise ValueError(f"{rule}, received {self}")


@dataclass(frozen=True, kw_only=True)
class Tune(SettingsSection):
    """A sweep over settings of one method. It never reads future frames.

    Optuna minimizes the mean loss over the configuration's scenarios.
    """

    study: Annotated[Name, StringConstraints(max_length=60)]
    """Name of the sweep and of its folder in `<results>/tune`. Method, space, settings and data of a sweep cannot change."""
    method: Name
    """Method whose settings vary. Trial 0 uses the settings of the method and of its search."""
    space: dict[str, Dimension]
    """Setting -> values, see [tune.space](#tunespace). Keys are dotted paths of `simulation`, `losses`, `search`, `fit`,
    `released_quirks`, and `clusters`, the number of regions of the method's search."""
    trials: Count = 40
    """Total number of finished, pruned and failed trials. Increase it to continue a sweep."""
    workers: Count = 1
    """Number of jobs that share the sweep."""
    storage: str | None = None
    """PostgreSQL URI for workers on several machines; null: SQLite in the sweep's folder. The URI must not contain a password:
    libpq reads PGPASSWORD or ~/.pgpass. SQLite works only for workers on one machine."""

    def __post_init__(self) -> None:
        if not self.space:
            raise ValueError("space: at least one setting is required")
        if self.storage:
            if not re.fullmatch(r"postgresql(\+\w+)?://\S+", self.storage):
                rule = "must be postgresql://HOST/DATABASE, or null (SQLite, for workers on one machine)"
                raise ValueError(f"storage: {rule}; received {self.storage!r}")
            refuse_password("storage", self.storage, "PGPASSWORD or ~/.pgpass")
