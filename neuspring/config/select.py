"""A part of the configuration, for a step that reads no more than this part."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from neuspring.config.parse import plain
from neuspring.config.settings import Config


def select(config: Config, keys: Iterable[str]) -> dict[str, Any]:
    """The values under dotted keys (`images.backend`), nested as in a configuration file, as plain values."""
    values = plain(config)
    part: dict[str, Any] = {}
    for key in keys:
        *sections, last = key.split(".")
        source, target = values, part
        for section in sections:
            source, target = source[section], target.setdefault(section, {})
        target[last] = source[last]
    return part
