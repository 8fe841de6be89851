"""The workflow on this machine without make: the location of its files, and the command that runs it."""

from __future__ import annotations

import os
import sys
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.core.provenance import PACKAGE_FOLDER

SNAKEFILE = "Snakefile"


def workflow_folder() -> Path:
    """The folder of Snakefile, workflow/ and config/: the checkout, or the folder of the installation. Raises InputError."""
    if (PACKAGE_FOLDER.parent / SNAKEFILE).is_file():
        return PACKAGE_FOLDER.parent
    try:
        for file in files("neuspring") or ():
            if file.name == SNAKEFILE and (path := Path(str(file.locate()))).is_file():
                return path.resolve().parent
    except PackageNotFoundError:
        pass
    raise InputError("workflow", "the package must contain its Snakefile", "none", "Use a checkout, or install from one.")


def require_writable() -> None:
    """Raise InputError if Snakemake cannot write its state to the current folder."""
    if not os.access(Path.cwd(), os.W_OK):
        remedy = "Run the command in another folder, or name one with Snakemake's --directory."
        raise InputError(Path.cwd(), "this folder must be writable, for Snakemake's state and results", None, remedy)


def workflow_command(data: str, *options: str, cores: int | None = None) -> list[str]:
    """The command that runs config/data/<data>.yaml on `cores` cores (default: all); `options` are Snakemake's."""
    root = workflow_folder()
    if "--directory" not in options:
        require_writable()
    # Messages print this command for users to repeat, so it contains relative paths if possible.
    root = Path() if root == Path.cwd() and "--directory" not in options else root
    count = cores or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()) or 1
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(root / SNAKEFILE)]
    command += ["--profile", str(root / "workflow" / "profiles" / "default"), "--cores", str(count)]
    command += ["--quiet", "host", "progress", "rules", "reason"]
    return [*command, "--configfile", str(root / "config" / "data" / f"{data}.yaml"), *options]
