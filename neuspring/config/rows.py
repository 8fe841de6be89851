"""Rows of the tables of scenarios, methods and searches."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from neuspring.core.section import Count, Name, SettingsSection


@dataclass(frozen=True, kw_only=True)
class SearchRow(SettingsSection):
    """A search: the number of regions, and its own settings."""

    clusters: Count | None = None
    """Number K of regions, each with its own radius and number of neighbors (2K + 10 variables); 1: uniform topology; null: the
    key `clusters`."""
    body: Name = "lattice"
    """Kind of body: lattice (springs between nodes), or the body of a package."""
    description: str
    """Description for tables."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Keys of `search`, which override the configuration."""
    released_quirks: dict[str, Any] = field(default_factory=dict)
    """Keys of `released_quirks`, which override the configuration for this search and its fits."""


@dataclass(frozen=True, kw_only=True)
class Method(SettingsSection):
    """A method: a search with or without a fit, a baseline's model, or the mean over seeds."""

    description: str
    """Description for tables."""
    title: str = ""
    """Display name: title PhysTwin is shown as PhysTwin (`baseline`). `extends` does not inherit it."""
    search: Name | None = None
    """Search of this method; methods with the same search share its result."""
    fit: Name | None = None
    """Unknowns of the fit: every spring (springs), the neural spring field (field), or a fit of another body; null: no fit."""
    model: Name | None = None
    """Baseline without search and fit, a name of `BASELINES`."""
    mean_of: Name | None = None
    """Another method, whose predictions are averaged over all seeds; null: none."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Keys of `fit`, or of the model's section of `baselines`, which override the configuration."""
    appearance: dict[str, Any] | None = None
    """Keys of `images.appearance` for splats of this method alone, which override the configuration; null: shared splats."""
    oracle: bool = False
    """Fit all frames, including future frames. An oracle predicts nothing: it measures how much of an error fitting could remove,
    and it is excluded from all comparisons. Its records contain `oracle`, and it shares its fit only with other oracles."""
    pool: Literal["all"] | None = None
    """Recordings on which one twin is fitted: all of the scenario's pool (all), or the scenario alone (null)."""

    @property
    def searched(self) -> str:
        """The name of the search, with the pool on which it is made."""
        return f"{self.search}-{self.pool}" if self.pool else self.search or ""

    def __post_init__(self) -> None:
        kinds = {"search": self.search, "model": self.model, "mean_of": self.mean_of}
        if sum(value is not None for value in kinds.values()) != 1:
            received = ", ".join(f"{name} {value}" for name, value in kinds.items() if value is not None)
            raise ValueError(f"exactly one of {', '.join(kinds)} is required, received {received or 'none'}")
        twins_only = {"fit": self.fit, "pool": self.pool}
        if self.oracle and not self.fit:
            raise ValueError("oracle: an oracle must have a fit; received fit null")
        misplaced = [name for name, value in twins_only.items() if value]
        if not self.search and misplaced:
            kind = f"model {self.model}" if self.model else f"the mean of {self.mean_of}"
            raise ValueError(f"{', '.join(misplaced)}: only methods with a search may have these keys, not {kind}")


@dataclass(frozen=True, kw_only=True)
class ScenarioRow(SettingsSection):
    """A capture and its settings for the simulation."""

    scenario: Name
    """Name of the scenario."""
    source: Name
    """Kind of data: phystwin, toy, synthetic, capture, points, phystwin_raw, or a source of a package."""
    category: Name
    """Kind of object, for example rope, cloth, package or sloth."""
    path: str
    """Folder or file in data_root; for toy and synthetic scenes, the name of the scene."""
    self_collision: bool
    """Whether the object can touch itself."""
    ground: bool
    """Whether there is a ground."""
