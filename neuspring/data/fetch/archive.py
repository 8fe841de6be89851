"""The released PhysTwin archives: which of their files belong to which part of which scenario, and where they go.

The real archives have not been opened yet. The folders that hold scenarios are searched for inside an archive, not assumed.
"""

from __future__ import annotations

import itertools
import re
import stat
import zipfile
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.core.progress import Progress
from neuspring.data import phystwin
from neuspring.data.cases import released_cases
from neuspring.data.fetch.hub import HubFile, RemoteFile

CASES = "data/different_types"
"""Where processed cases lie below data_root."""
EXTRA = "additional_data"
TREES: dict[str, tuple[str, tuple[str, ...]]] = {
    CASES: ("data.zip", ("data", "images", "other")),
    "data/gaussian_data": ("data.zip", ("appearance",)),
    "data/render_eval_data": ("data.zip", ("appearance",)),
    "data/different_types_human_mask": ("data.zip", ("appearance",)),
    "experiments_optimization": ("experiments_optimization.zip", ("results",)),
    "experiments": ("experiments.zip", ("results",)),
    "gaussian_output": ("gaussian_output.zip", ("appearance",)),
    EXTRA: ("additional_data.zip", ("extra",)),
}
"""Folder below data_root -> its archive, and the parts that its files belong to."""
_DATA = re.compile(rf"({'|'.join(map(re.escape, (*phystwin.FILES, 'calibrate.pkl')))}|cotracker/\d+\.npz|depth/\d+/0\.npy)")
_IMAGES = re.compile(
    r"(color/\d+/\d+\.png|depth/\d+/\d+\.npy|mask/\d+/\d+/\d+\.png|mask/mask_info_\d+\.json|metadata\.json|calibrate\.pkl)"
)


@dataclass(frozen=True)
class Member:
    """A file of an archive, and where it belongs."""

    info: zipfile.ZipInfo
    tree: str
    prefix: str
    """Folder inside the archive that holds the cases."""
    case: str
    """Empty for what belongs to no scenario."""
    rest: str
    """Path below the case."""

    @property
    def path(self) -> str:
        """Below data_root."""
        return "/".join(name for name in (self.tree, self.case, self.rest) if name)

    @property
    def parts(self) -> set[str]:
        """The parts that it belongs to; a file may belong to two."""
        if self.tree != CASES:
            return set(TREES[self.tree][1])
        parts = {name for name, pattern in (("data", _DATA), ("images", _IMAGES)) if pattern.fullmatch(self.rest)}
        return parts or {"other"}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is to be extracted from one archive."""

    file: HubFile
    archive: zipfile.ZipFile
    members: int
    """Number of files in the archive."""
    wanted: list[Member]
    """The files that were asked for."""
    missing: list[Member]
    """The wanted files that are not on disk in the archive's state, in the archive's order."""
    differing: int
    """Number of missing files for which the disk has a file of other content."""
    absent: dict[str, list[str]]
    """Part -> scenarios for which the archive does not have it."""
    cost: int
    """Bytes to fetch."""


def archives(parts: set[str]) -> list[str]:
    """The archives that hold `parts`."""
    return list(dict.fromkeys(archive for archive, contents in TREES.values() if parts & set(contents)))


def make_plan(file: HubFile, remote: RemoteFile, cases: list[str], parts: set[str], data_root: Path) -> Plan:
    """Plan what to extract from the archive `file`, open as `remote`, for `parts` of `cases`. Reads its table of contents.

    Raises InputError if it is no zip archive, holds nothing that was asked for, or holds an unsafe file: a link, an encrypted file
    or a path that leads elsewhere.
    """
    try:
        archive = zipfile.ZipFile(remote)
    except (zipfile.BadZipFile, NotImplementedError) as error:
        raise InputError(file.name, "must be a zip archive", str(error), "Choose another --revision.") from error
    files = [info for info in archive.infolist() if not info.is_dir()]
    wanted = _wanted(file.name, files, cases, parts)
    missing, differing = _missing(file.name, wanted, data_root)
    return Plan(
        file=file,
        archive=archive,
        members=len(files),
        wanted=wanted,
        missing=missing,
        differing=differing,
        absent=_absent(file.name, wanted, cases, parts),
        cost=remote.expect(_spans(archive, missing)),
    )


def _wanted(name: str, files: list[zipfile.ZipInfo], cases: list[str], parts: set[str]) -> list[Member]:
    for info in files:
        _refuse(name, info, _path_faults(info.filename))
    trees = [tree for tree, (archive, _) in TREES.items() if archive == name]
    located = _one_prefix([member for info in files if (member := _locate(info, trees)) is not None])
    wanted = [member for member in located if member.parts & parts and member.case in ("", *cases)]
    if not wanted:
        folders = sorted({"/".join(info.filename.split("/")[:3]) for info in files})
        rule = f"must hold the parts {', '.join(sorted(parts))} of {', '.join(cases)}"
        raise InputError(name, rule, "none of them", f"First paths in the archive: {', '.join(folders[:8]) or 'none'}.")
    for member in wanted:
        _refuse(name, member.info, _kind_faults(member.info))
    return wanted


def _locate(info: zipfile.ZipInfo, trees: list[str]) -> Member | None:
    """Where a file belongs: below the name of a case, in a folder with the name of a tree; None elsewhere."""
    names = [name for name in info.filename.split("/") if name not in ("", ".")]
    if not names or names[0] == "__MACOSX" or names[-1] == ".DS_Store" or names[-1].startswith("._"):
        return None
    if trees == [EXTRA]:
        start = names.index(EXTRA) + 1 if EXTRA in names[:-1] else 0
        return Member(info, EXTRA, "/".join(names[:start]), "", "/".join(names[start:]))
    place = next((i for i, name in enumerate(names[:-1]) if name in released_cases()), None)
    if place is None:
        return None
    prefix = "/".join(names[:place])
    named = [tree for tree in trees if _is_named(tree, prefix)]
    if not named and len(trees) > 1:
        return None
    tree = (named or trees)[0]  # an archive of one tree may call its folder what it likes
    return Member(info, tree, prefix, names[place], "/".join(names[place + 1 :]))


def _one_prefix(members: list[Member]) -> list[Member]:
    """Keep one folder per tree: the one with the tree's name, else with most files, else with the shortest path."""
    counts = Counter((member.tree, member.prefix) for member in members)
    ranked = sorted(counts, key=lambda place: (_is_named(*place), counts[place], -len(place[1])))
    prefixes = dict(ranked)
    # In a zip archive, the last of several entries with one name counts.
    return list({member.path: member for member in members if member.prefix == prefixes[member.tree]}.values())


def _is_named(tree: str, prefix: str) -> bool:
    return tree.rpartition("/")[2] == prefix.rpartition("/")[2]


def _refuse(name: str, info: zipfile.ZipInfo, faults: dict[str, bool]) -> None:
    if fault := next((fault for fault, holds in faults.items() if holds), None):
        rule = "an archive may hold plain files at relative paths only"
        raise InputError(f"{name}: {info.filename!r}", rule, fault, "Nothing was extracted. Choose another --revision.")


def _path_faults(path: str) -> dict[str, bool]:
    return {
        "an absolute path": path.startswith(("/", "\\")) or re.match(r"[A-Za-z]:", path) is not None,
        "a path with ..": ".." in re.split(r"[/\\]", path),
        "a path with a backslash or control character": re.search(r"[\\\x00-\x1f]", path) is not None,
    }


def _kind_faults(info: zipfile.ZipInfo) -> dict[str, bool]:
    kind = stat.S_IFMT(info.external_attr >> 16)
    return {"a link or special file": kind not in (0, stat.S_IFREG), "an encrypted file": bool(info.flag_bits & 1)}


def _missing(name: str, wanted: list[Member], data_root: Path) -> tuple[list[Member], int]:
    """Members that are not on disk with their size and CRC-32, and how many files on disk have another content."""
    there = [member for member in wanted if (data_root / member.path).exists()]
    progress = Progress(f"{name}: checking files that are there", len(there))
    finished = set()
    for count, member in enumerate(there, start=1):
        if _is_finished(data_root / member.path, member.info):
            finished.add(member.path)
        progress.update(count)
    missing = [member for member in wanted if member.path not in finished]
    return sorted(missing, key=lambda member: member.info.header_offset), len(there) - len(finished)


def _is_finished(path: Path, info: zipfile.ZipInfo) -> bool:
    if not path.is_file() or path.stat().st_size != info.file_size:
        return False
    crc = 0
    with path.open("rb") as stream:
        while block := stream.read(2**20):
            crc = zlib.crc32(block, crc)
    return crc == info.CRC


def _spans(archive: zipfile.ZipFile, members: list[Member]) -> list[tuple[int, int]]:
    """Where the members lie in the archive: each reaches to the next one, or to the table of contents."""
    starts = {info.header_offset for info in archive.infolist()} | {archive.start_dir}
    ends = dict(itertools.pairwise(sorted(starts)))
    return [(offset, ends.get(offset, archive.start_dir)) for offset in sorted({member.info.header_offset for member in members})]


def _absent(name: str, wanted: list[Member], cases: list[str], parts: set[str]) -> dict[str, list[str]]:
    """Part (and its folder) -> scenarios without it. `other` and `extra` are left out: what they should hold is unknown."""
    present = {(member.tree, member.case, part) for member in wanted for part in member.parts}
    absent = {}
    for tree, (archive, contents) in TREES.items():
        for part in contents:
            if archive == name and part in parts - {"other", "extra"}:
                absent[f"{part} ({tree})"] = [case for case in cases if (tree, case, part) not in present]
    return {part: without for part, without in absent.items() if without}
