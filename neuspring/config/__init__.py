"""Every setting: what it means, its unit, its range and its default, as frozen dataclasses that refuse unknown keys.

`settings` holds the whole configuration and `parse`; each other module is one section of config/README.md. Nothing here imports
torch, Warp or MLflow, because the workflow reads the configuration before any job exists.
"""

from neuspring.config.settings import (
    Clusters,
    Config,
    Fit,
    Kind,
    Losses,
    Method,
    Mocap,
    ReleasedQuirks,
    ScenarioRow,
    Search,
    SearchRanges,
    SearchRow,
    SearchStart,
    Simulation,
    SpringField,
    Toy,
    Tracking,
    merge,
    parse,
    plain,
    read_text,
    read_yaml,
)

__all__ = [
    "Clusters",
    "Config",
    "Fit",
    "Kind",
    "Losses",
    "Method",
    "Mocap",
    "ReleasedQuirks",
    "ScenarioRow",
    "Search",
    "SearchRanges",
    "SearchRow",
    "SearchStart",
    "Simulation",
    "SpringField",
    "Toy",
    "Tracking",
    "merge",
    "parse",
    "plain",
    "read_text",
    "read_yaml",
]
