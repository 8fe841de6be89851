"""A run claims its results folder, so that no other run replaces what it makes.

The claim is a lock of the kernel on a file that says who holds it. It ends with the process, however that ends.
"""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path
from typing import IO

from neuspring.core.errors import InputError
from neuspring.core.job_records import FOLDER
from neuspring.core.lock import try_lock
from neuspring.core.records import now

CLAIMS: list[IO[str]] = []
"""Open files: closing one would end its claim."""


def claim(results: Path, settings: str) -> None:
    """Claim a results folder for a run of these settings until this process ends.

    Raises InputError where another run holds it. A file system without locks has no claims, which a warning says.
    """
    path = results / FOLDER / "run.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        file = try_lock(path)
    except OSError as error:
        print(f"warning: {path} cannot be locked ({error.strerror}): start no second run with results={results}.", flush=True)
        return
    if file is None:
        raise _held(results, path, settings)
    file.truncate(0)
    json.dump({"pid": os.getpid(), "host": platform.node(), "since": now(), "settings": settings}, file)
    file.flush()
    CLAIMS.append(file)


def _held(results: Path, path: Path, settings: str) -> InputError:
    try:
        holder = json.loads(path.read_text())
    except (OSError, ValueError):
        holder = {}
    alike = "the same" if holder.get("settings") == settings else "other"
    who = f"process {holder.get('pid')} on {holder.get('host')} since {holder.get('since')}, with {alike} settings"
    return InputError(
        results, "one run at a time works in a results folder", who, "Wait for its end, or use --config results=OTHER_FOLDER."
    )
