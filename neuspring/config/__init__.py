"""All settings with meaning, unit, range and default, as frozen dataclasses that reject unknown keys.

    settings                       the complete configuration (`Config`), GPUs, the part of it that a step reads
    simulation, search, twin       integration; the search; losses, field, fit
    data, perception, images       sources; raw video to observations; splats and their scores
    extensions, tuning             sections of packages; sweeps over settings
    rows                           rows of the scenario, method and search tables
    parse                          YAML to settings and back

`tests/config/page.py` writes config/README.md from these modules. They import neither torch, Warp nor MLflow, because the
workflow reads the configuration before any job exists.
"""

from neuspring.config.data import Toy
from neuspring.config.parse import merge, of_command_line, parse, plain, read_text, read_yaml
from neuspring.config.rows import Method, ScenarioRow, SearchRow
from neuspring.config.search import Search, SearchVariables, Variable
from neuspring.config.settings import Config, Tracking
from neuspring.config.simulation import ReleasedQuirks, SimulationSettings
from neuspring.config.twin import Fit, Losses, SpringFieldSettings

__all__ = [
    "Config",
    "Fit",
    "Losses",
    "Method",
    "ReleasedQuirks",
    "ScenarioRow",
    "Search",
    "SearchRow",
    "SearchVariables",
    "SimulationSettings",
    "SpringFieldSettings",
    "Toy",
    "Tracking",
    "Variable",
    "merge",
    "of_command_line",
    "parse",
    "plain",
    "read_text",
    "read_yaml",
]
