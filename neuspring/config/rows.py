"""Rows of the tables that a configuration names: scenarios, methods, searches."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from neuspring.core.section import Count, Name, SettingsSection


@dataclass(frozen=True, kw_only=True)
class SearchRow(SettingsSection):
    """A row of the search table: into how many regions the topology is divided, and settings of its own."""

    clusters: Count | None = None
    """Number K of regions, each with its own radius and neighbors: 2K + 10 variables; 1 is the uniform topology; null: the key
    `clusters`."""
    body: Name = "lattice"
    """lattice: springs between nodes; or the body of a package."""
    description: str
    """A line for people."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Search settings of this row alone (keys of `search`), on top of the configuration's."""
    released_quirks: dict[str, Any] = field(default_factory=dict)
    """Keys of `released_quirks`, on top of the configuration's, for this search and the fits that start from it."""


@dataclass(frozen=True, kw_only=True)
class Method(SettingsSection):
    """A row of the method table: a twin (which search it starts from, what follows), a baseline's model, or the mean of seeds."""

    description: str
    """A line for people."""
    title: str = ""
    """Name for people, before the row's own: title PhysTwin is shown as PhysTwin (`baseline`). `extends` does not hand it on."""
    search: Name | None = None
    """A row of the search table; methods that name the same row share the search."""
    fit: Name | None = None
    """Unknowns that the first-order stage trains: each spring by itself, the neural spring field, or those of another body; null:
    there is no such stage."""
    model: Name | None = None
    """A baseline, which has neither search nor fit, by its name in `BASELINES`."""
    mean_of: Name | None = None
    """Another row, which is run too: the prediction is the mean of those of all its seeds; null: this row predicts itself."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of this method alone, on top of the configuration's: keys of `fit` (for example `horizon: 0`), or of its model's
    section of `baselines`."""
    appearance: dict[str, Any] | None = None
    """Splats of this method alone: keys of `images.appearance`, on top of the configuration's; null: the splats that all
    methods share."""
    oracle: bool = False
    """Fit of all frames, the future included, from the same search. Such a row predicts nothing: it says how much of an error
    fitting could remove at all, and stands outside every comparison. Its records say so, and it shares its fit with other oracles
    only."""
    pool: Literal["all"] | None = None
    """Recordings of the object (`pools`) that one twin is judged on: the scenario's own and the others of its pool (all); null:
    the scenario's own."""

    @property
    def searched(self) -> str:
        """The name of its search: the row's, and on which recordings of the pool it is made."""
        return f"{self.search}-{self.pool}" if self.pool else self.search or ""

    def __post_init__(self) -> None:
        kinds = {"search": self.search, "model": self.model, "mean_of": self.mean_of}
        if sum(value is not None for value in kinds.values()) != 1:
            received = ", ".join(f"{name} {value}" for name, value in kinds.items() if value is not None)
            raise ValueError(f"one of {', '.join(kinds)} is required, received {received or 'none'}")
        twins_only = {"fit": self.fit, "pool": self.pool}
        if self.oracle and not self.fit:
            raise ValueError("oracle: an oracle has a fit; received fit null")
        misplaced = [name for name, value in twins_only.items() if value]
        if not self.search and misplaced:
            kind = f"model {self.model}" if self.model else f"the mean of {self.mean_of}"
            raise ValueError(f"{', '.join(misplaced)}: these belong to methods with a search, not to {kind}")


@dataclass(frozen=True, kw_only=True)
class ScenarioRow(SettingsSection):
    """A row of the scenario table: where a capture comes from, and what the simulation must know of it."""

    scenario: Name
    """Name of the scenario."""
    source: Name
    """The kind of its data: phystwin, toy, synthetic, capture, points, phystwin_raw, or one of a package."""
    category: Name
    """Kind of object, for example rope, cloth, package or sloth."""
    path: str
    """Folder or file under data_root; for toy and synthetic scenes, the scene's name."""
    self_collision: bool
    """True where the object may touch itself."""
    ground: bool
    """True where there is a ground."""
