"""JSON files of data sets."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from neuspring.core.errors import InputError


def load_json(path: Path) -> Any:
    """Parse a JSON file of the data set. Raises InputError."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, "this file must be readable", error.strerror) from error
    except (ValueError, RecursionError) as error:
        raise InputError(path, "this file must be JSON", str(error)) from error
