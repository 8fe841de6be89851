"""Exclusive use of a results folder by one run of the workflow.

A claim is a kernel lock on a file that names its holder. It ends with the process, also if the process is killed.
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
"""Open files of claims: closing a file would end its claim."""


def claim(results: Path, settings: str) -> None:
    """Claim a results folder for a run with these settings until this process ends.

    Raises InputError if another run holds the claim. On a file system without locks it only prints a warning.
    """
    path = results / FOLDER / "run.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        file = try_lock(path)
    except OSError as error:
        print(f"warning: {path} cannot be locked ({error.strerror}); start no second run with results={results}.", flush=True)
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
    kind = "the same" if holder.get("settings") == settings else "other"
    who = f"process {holder.get('pid')} on {holder.get('host')} since {holder.get('since')}, with {kind} settings"
    return InputError(
        results, "only one run at a time may use a results folder", who, "Wait for its end, or use --config results=OTHER_FOLDER."
    )
