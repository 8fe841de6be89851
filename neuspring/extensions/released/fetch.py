"""`neuspring fetch phystwin`: files of PhysTwin's release, from the Hugging Face hub to the folders that readers expect.

HTTP range requests read only the requested files; no archive is stored. A file is complete if its size and CRC-32 equal those of
the archive member. The same command resumes an interrupted fetch.
"""

from __future__ import annotations

import os
import re
import shutil
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

from huggingface_hub import HfFileSystem
from huggingface_hub.utils import httpx

from neuspring.core.errors import InputError
from neuspring.core.text import Progress
from neuspring.intake.phystwin import released_cases

REPOSITORY = "Jianghanxiao/PhysTwin"
TREES = {
    "data/different_types": "data.zip",
    "experiments": "experiments.zip",
    "experiments_optimization": "experiments_optimization.zip",
}
"""Folder below data_root -> the archive that contains it."""
PARTS = {
    "data": {"data/different_types": r"(?:final_data|gt_track_3d|calibrate)\.pkl|(?:split|metadata)\.json"},
    "images": {
        "data/different_types": r"(?:color|depth)/\d+/\d+\.(?:png|npy)|mask/\d+/\d+/\d+\.png|mask/mask_info_\d+\.json"
        r"|metadata\.json|calibrate\.pkl"
    },
    "results": {"experiments": r"inference\.pkl|train/best_\d+\.pth", "experiments_optimization": r"optimal_params\.pkl"},
}
"""Part -> its folders, and the names of files in the folder of a case there. No other file is written."""


def fetch(
    data_root: Path, scenarios: Sequence[str], parts: Sequence[str], revision: str = "main", *, dry_run: bool = False
) -> None:
    """Fetch `parts` (keys of PARTS) of `scenarios` (default: all 22) to `data_root`; a dry run only prints sizes.

    Raises InputError for unknown names, for an archive that is damaged or has none of the files, and for errors of hub or disk.
    """
    for where, names, known in (("SCENARIO", scenarios, released_cases()), ("--parts", parts, PARTS)):
        if unknown := [name for name in names if name not in known]:
            raise InputError(where, f"must be among {', '.join(known)}", ", ".join(unknown))
    cases = "|".join(map(re.escape, scenarios or released_cases()))
    system = HfFileSystem(token=os.environ.get("HF_TOKEN") or False)
    for tree, archive_name in TREES.items():
        if not (patterns := [PARTS[part][tree] for part in parts if tree in PARTS[part]]):
            continue
        member = re.compile(rf"(?:.*/)?{Path(tree).name}/((?:{cases})/(?:{'|'.join(patterns)}))")
        try:
            path = f"datasets/{REPOSITORY}@{revision}/{archive_name}"
            with system.open(path, block_size=2**22, cache_type="readahead") as remote, zipfile.ZipFile(remote) as archive:
                _extract(archive, member, data_root / tree, archive_name, dry_run)
        except (httpx.HTTPError, OSError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
            remedy = "Check network, disk, --revision, HF_ENDPOINT and HF_TOKEN; then rerun the same command to resume."
            reason = f"{type(error).__name__}: {error}".partition("\n")[0]
            raise InputError(f"{REPOSITORY}, {archive_name}", "the archive must be readable", reason, remedy) from error


def _extract(archive: zipfile.ZipFile, pattern: re.Pattern[str], folder: Path, name: str, dry_run: bool) -> None:
    """Write the matching members to `folder`, except complete files."""
    wanted = {folder / match[1]: info for info in archive.infolist() if (match := pattern.fullmatch(info.filename))}
    if not wanted:
        first = ", ".join(archive.namelist()[:8])
        raise InputError(name, f"must contain files {pattern.pattern}", "none", f"Check --revision. The first paths are {first}.")
    missing = {path: info for path, info in wanted.items() if not _is_complete(path, info)}
    size = sum(info.compress_size for info in missing.values()) / 1e6
    print(f"{name}: {len(wanted)} files; {len(missing)} are missing ({size:,.1f} MB)")
    progress = Progress(f"{name}: files", len(missing))
    # The archive's order makes use of the data that are read ahead.
    for count, path in enumerate(sorted(missing, key=lambda path: missing[path].header_offset) if not dry_run else (), start=1):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.part")
        try:
            with archive.open(missing[path]) as source, part.open("wb") as sink:
                shutil.copyfileobj(source, sink)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
        progress.update(count)


def _is_complete(path: Path, info: zipfile.ZipInfo) -> bool:
    return path.is_file() and path.stat().st_size == info.file_size and zlib.crc32(path.read_bytes()) == info.CRC
