"""The public configurations, and the plain values that a network and its rollout need of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

from neuspring.config.gs_dynamics import GsDynamics, NodeInput, Propagation, Tools

PresetName = Literal["rope", "animals", "cloth"]
Values = TypeVar("Values")


@dataclass(frozen=True)
class Preset:
    """What differs between kinds of objects; meanings as in GsDynamics."""

    radius: float
    neighbours: int
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
    """How graphs are made and what the network sees; with its weights, all that a rollout needs. Meanings as in GsDynamics."""

    radius: float
    neighbours: int
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
    """Settings with every null replaced by the value of the preset."""
    preset = PRESETS[preset_name(settings, category)]

    def own(name: str) -> dict[str, object]:
        chosen = getattr(settings, name)
        return {name: getattr(preset, name) if chosen is None else chosen}

    connect_all = settings.tools == "centroids" if settings.connect_all is None else settings.connect_all
    rules = own("radius") | own("neighbours") | own("particles") | own("node_input") | {"connect_all": connect_all}
    recipe = own("noise") | own("length_weight") | own("batch")
    return _filled(Rules, settings, rules), _filled(Recipe, settings, recipe)


def _filled(kind: type[Values], settings: GsDynamics, chosen: dict[str, object]) -> Values:
    others = {name: getattr(settings, name) for name in kind.__annotations__ if name not in chosen}
    return kind(**chosen | others)
