"""The public configurations per kind of object, and the plain values that networks, rollouts and training take from them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from neuspring.config.gs_dynamics import GsDynamics, NodeInput, Propagation, Tools

PresetName = Literal["rope", "animals", "cloth"]


@dataclass(frozen=True)
class Preset:
    """Settings that differ between kinds of objects. Meanings as in GsDynamics."""

    radius: float
    neighbors: int
    particles: int
    noise: float
    length_weight: float
    batch: int
    node_input: NodeInput


PRESETS: dict[PresetName, Preset] = {
    "rope": Preset(0.08, 5, 100, 0.003, 0.1, 16, "short"),
    "animals": Preset(0.08, 6, 100, 0.003, 0.05, 64, "full"),
    "cloth": Preset(0.075, 6, 150, 0.002, 0.1, 64, "full"),
}
CLOTHS = ("cloth", "package")


def preset_name(settings: GsDynamics, category: str) -> PresetName:
    """The preset of an object's category."""
    if settings.preset != "auto":
        return settings.preset
    # The cables of the motion-capture data are DLO1, DLO2, ...
    if category == "rope" or category.startswith("DLO"):
        return "rope"
    return "cloth" if category in CLOTHS else "animals"


@dataclass(frozen=True, kw_only=True)
class Rules:
    """How graphs are made and what the network sees. A rollout needs these and the weights. Meanings as in GsDynamics."""

    radius: float
    neighbors: int
    particles: int
    coverage: float
    connect_all: bool
    node_input: NodeInput
    tools: Tools
    width: int
    rounds: int
    history: int
    step: float
    propagation: Propagation
    nearest: int
    interpolate: bool

    @property
    def node_size(self) -> int:
        """Inputs per node: kind 2, heights H, displacements 3 (H - 1), action 3."""
        return 5 + (4 * self.history - 3 if self.node_input == "full" else 0)

    @property
    def edge_size(self) -> int:
        """Inputs per edge: kinds 2 + 2, whether they differ 1, receiver - sender 3 H."""
        return 5 + 3 * self.history


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How the network is trained. Meanings as in GsDynamics."""

    noise: float
    yaw: bool
    length_weight: float
    batch: int
    faithful_length_loss: bool
    padded_mean: bool


def resolve(settings: GsDynamics, category: str) -> tuple[Rules, Recipe]:
    """The settings of a model and of its training, with every null replaced by the value of the preset."""
    values = vars(PRESETS[preset_name(settings, category)]) | {"connect_all": settings.tools == "centroids"}
    values |= {name: value for name, value in vars(settings).items() if value is not None}
    rules, recipe = ({field.name: values[field.name] for field in fields(kind)} for kind in (Rules, Recipe))
    return Rules(**rules), Recipe(**recipe)
