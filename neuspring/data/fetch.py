"""`neuspring fetch phystwin`: the released PhysTwin archives, from the Hugging Face hub into the folders that the readers expect.

Only the files that were asked for are read, by HTTP range requests: one scenario does not cost an archive, and no archive is
stored. The same command continues an interrupted fetch: a file with the size and CRC-32 of its archive member is finished, any
other starts again. The archive's SHA-256 is recorded, the CRC-32 of every file is checked. The folders that hold scenarios are
searched for inside an archive, not assumed.

It is tested against a local stand-in server with archives in the described layout. Neither the real hub nor the real archives have
been met.
"""

from __future__ import annotations

import difflib
import itertools
import json
import math
import re
import shutil
import stat
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.findings import Finding, broken
from neuspring.core.records import now, read_json
from neuspring.core.text import Progress
from neuspring.data import phystwin
from neuspring.data.check import check_layout, is_case
from neuspring.data.hub import Hub, HubFile, RemoteFile
from neuspring.data.phystwin import released_cases

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
class ArchiveMember:
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
class FetchPlan:
    """What is to be extracted from one archive."""

    file: HubFile
    archive: zipfile.ZipFile
    members: int
    """Number of files in the archive."""
    wanted: list[ArchiveMember]
    """The files that were asked for."""
    missing: list[ArchiveMember]
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


def make_plan(file: HubFile, remote: RemoteFile, cases: list[str], parts: set[str], data_root: Path) -> FetchPlan:
    """FetchPlan what to extract from the archive `file`, open as `remote`, for `parts` of `cases`. Reads its table of contents.

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
    return FetchPlan(
        file=file,
        archive=archive,
        members=len(files),
        wanted=wanted,
        missing=missing,
        differing=differing,
        absent=_absent(file.name, wanted, cases, parts),
        cost=remote.expect(_spans(archive, missing)),
    )


def _wanted(name: str, files: list[zipfile.ZipInfo], cases: list[str], parts: set[str]) -> list[ArchiveMember]:
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


def _locate(info: zipfile.ZipInfo, trees: list[str]) -> ArchiveMember | None:
    """Where a file belongs: below the name of a case, in a folder with the name of a tree; None elsewhere."""
    names = [name for name in info.filename.split("/") if name not in ("", ".")]
    if not names or names[0] == "__MACOSX" or names[-1] == ".DS_Store" or names[-1].startswith("._"):
        return None
    if trees == [EXTRA]:
        start = names.index(EXTRA) + 1 if EXTRA in names[:-1] else 0
        return ArchiveMember(info, EXTRA, "/".join(names[:start]), "", "/".join(names[start:]))
    place = next((i for i, name in enumerate(names[:-1]) if name in released_cases()), None)
    if place is None:
        return None
    prefix = "/".join(names[:place])
    named = [tree for tree in trees if _is_named(tree, prefix)]
    if not named and len(trees) > 1:
        return None
    tree = (named or trees)[0]  # an archive of one tree may call its folder what it likes
    return ArchiveMember(info, tree, prefix, names[place], "/".join(names[place + 1 :]))


def _one_prefix(members: list[ArchiveMember]) -> list[ArchiveMember]:
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


def _missing(name: str, wanted: list[ArchiveMember], data_root: Path) -> tuple[list[ArchiveMember], int]:
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


def _spans(archive: zipfile.ZipFile, members: list[ArchiveMember]) -> list[tuple[int, int]]:
    """Where the members lie in the archive: each reaches to the next one, or to the table of contents."""
    starts = {info.header_offset for info in archive.infolist()} | {archive.start_dir}
    ends = dict(itertools.pairwise(sorted(starts)))
    return [(offset, ends.get(offset, archive.start_dir)) for offset in sorted({member.info.header_offset for member in members})]


def _absent(name: str, wanted: list[ArchiveMember], cases: list[str], parts: set[str]) -> dict[str, list[str]]:
    """Part (and its folder) -> scenarios without it. `other` and `extra` are left out: what they should hold is unknown."""
    present = {(member.tree, member.case, part) for member in wanted for part in member.parts}
    absent = {}
    for tree, (archive, contents) in TREES.items():
        for part in contents:
            if archive == name and part in parts - {"other", "extra"}:
                absent[f"{part} ({tree})"] = [case for case in cases if (tree, case, part) not in present]
    return {part: without for part, without in absent.items() if without}


REPOSITORY = "Jianghanxiao/PhysTwin"
RECORD, RECORD_FORMAT = "fetched.json", 1
LOCK = ".fetch.lock"
PARTS = ("data", "results", "appearance", "images", "other")
"""Parts of a scenario. data: what the reader and check-data read. results: released parameters, checkpoints and predictions.
appearance: released splats, with masks and pictures of frame 0 and of the published evaluation. images: color, depth and masks of
every frame. other: everything else."""
DEFAULT_PARTS = ("data", "results")
ALLOCATION = 4096
"""File systems round the size of a file up to a multiple of this, bytes."""


def fetch(
    data_root: Path,
    scenarios: Sequence[str] = (),
    parts: Sequence[str] = DEFAULT_PARTS,
    *,
    revision: str = "main",
    dry_run: bool = False,
    endpoint: str | None = None,
    say: Callable[[str], None] = print,
    check: Callable[[Path], list[Finding]] = check_layout,
) -> list[Finding]:
    """Fetch `parts` of `scenarios` (default: all 22) below `data_root`, and check every scenario whose processed data are there.

    `parts` are of PARTS; "all" stands for every one of these, "extra" for the additional clothes. What will be fetched and the
    space it takes is said first; a dry run stops there. Files of other content are replaced. fetched.json records commit, archives
    and digests. Returns what `check` finds. Raises InputError, also if the disk is too small, an archive is damaged or unsafe, or
    the hub does not answer.
    """
    data_root = Path(data_root)
    cases, part_names = _scenarios(scenarios), _parts(parts)
    with ExitStack() as stack:
        stack.enter_context(_alone(data_root, dry_run))
        hub = Hub(REPOSITORY, revision, endpoint)
        say(f"{hub.repository} at {hub.commit} ({hub.endpoint})")
        plans = []
        for name in archives(part_names):
            if name not in hub.files:
                there = ", ".join(sorted(hub.files)) or "nothing"
                raise InputError(f"{hub.repository} at {hub.commit}", f"{name} is required", there, "Choose another --revision.")
            remote = stack.enter_context(hub.open(hub.files[name]))
            plan = make_plan(hub.files[name], remote, cases, part_names, data_root)
            say(_described(plan))
            plans.append(plan)
        _check_space(data_root, plans, say)
        if dry_run:
            return []
        for plan in plans:
            _extract(plan, data_root)
            _record(data_root / RECORD, hub, plan, cases, part_names)
    return _check(data_root, cases, "data" in part_names, check)


def _scenarios(names: Sequence[str]) -> list[str]:
    released = list(released_cases())
    for name in names:
        if name not in released:
            close = difflib.get_close_matches(name, released, n=3) or released
            raise InputError("SCENARIO", "must be one of the 22 released scenarios", name, f"Close to it: {', '.join(close)}.")
    return [name for name in released if name in names] if names else released


def _parts(names: Sequence[str]) -> set[str]:
    choices = (*PARTS, "extra", "all")
    for name in names:
        if name not in choices:
            raise InputError("--parts", f"must be among {', '.join(choices)}", name)
    return {part for name in names for part in (PARTS if name == "all" else (name,))}


@contextmanager
def _alone(data_root: Path, dry_run: bool) -> Iterator[None]:
    """Lock `data_root` against other fetches. Raises trouble with its files as InputError."""
    from filelock import FileLock, Timeout

    try:
        if dry_run:
            yield
            return
        data_root.mkdir(parents=True, exist_ok=True)
        with FileLock(data_root / LOCK, timeout=0):
            yield
    except Timeout as error:
        raise InputError(data_root, "one fetch at a time may write here", "another is at work", "Wait for it to end.") from error
    except OSError as error:
        remedy = "Free space or fix permissions; the same command continues."
        raise InputError(error.filename or data_root, "must be readable and writable", error.strerror or error, remedy) from error


def _described(plan: FetchPlan) -> str:
    there = len(plan.wanted) - len(plan.missing)
    replaced = f", {plan.differing} with other content on disk are replaced" if plan.differing else ""
    size = sum(member.info.file_size for member in plan.missing)
    lines = [
        f"{plan.file.name}: {len(plan.wanted)} of {plan.members} files asked for, {there} are there{replaced}; "
        f"{_size(plan.cost)} of {_size(plan.file.size)} to fetch, {_size(size)} on disk"
    ]
    lines += [f"{plan.file.name} has no {what} of {', '.join(cases)}" for what, cases in plan.absent.items()]
    return "\n".join(lines)


def _size(count: int) -> str:
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.1f} {unit}"
    return f"{count} B"


def _check_space(data_root: Path, plans: list[FetchPlan], say: Callable[[str], None]) -> None:
    needed = sum(math.ceil(member.info.file_size / ALLOCATION) * ALLOCATION for plan in plans for member in plan.missing)
    place = next(path for path in (data_root.absolute(), *data_root.absolute().parents) if path.exists())
    free = shutil.disk_usage(place).free
    say(f"Space needed in {data_root}: {_size(needed)}; free: {_size(free)}")
    if needed > free:
        remedy = "Free space, choose another folder, fewer scenarios or fewer --parts."
        raise InputError(data_root, f"{_size(needed)} must be free", _size(free), remedy)


def _extract(plan: FetchPlan, data_root: Path) -> None:
    progress, done = Progress(f"{plan.file.name}: files", len(plan.missing)), 0
    for count, member in enumerate(plan.missing, start=1):
        target = data_root / member.path
        part = target.with_name(f".{target.name}.part")
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with plan.archive.open(member.info) as source, part.open("wb") as sink:
                shutil.copyfileobj(source, sink, 2**20)
            part.replace(target)
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
            remedy = "Run the same command again; if it repeats, the archive itself is damaged: choose another --revision."
            where = f"{plan.file.name}: {member.info.filename}"
            raise InputError(where, "must be what the archive declares", str(error), remedy) from error
        finally:
            part.unlink(missing_ok=True)
        done += member.info.file_size
        progress.update(count, f"{_size(done)} {member.case}")


def _record(path: Path, hub: Hub, plan: FetchPlan, cases: list[str], parts: set[str]) -> None:
    """Add an entry to fetched.json, unless nothing was missing and the same is recorded already."""
    entries = read_json(path, RECORD_FORMAT)["fetched"] if path.exists() else []
    content = {
        "repository": hub.repository,
        "revision": hub.commit,
        "archive": plan.file.name,
        "sha256": plan.file.sha256,
        "size": plan.file.size,
        "parts": sorted(parts & {part for member in plan.wanted for part in member.parts}),
        "scenarios": cases,
    }
    if not plan.missing and any(content.items() <= entry.items() for entry in entries):
        return
    entry = content | {"endpoint": hub.endpoint, "date": now(), "files": len(plan.missing)}
    write_text(path, json.dumps({"format": RECORD_FORMAT, "fetched": [*entries, entry]}, indent=1) + "\n")


def _check(data_root: Path, cases: list[str], required: bool, check: Callable[[Path], list[Finding]]) -> list[Finding]:
    """Check the cases that have processed data; an error for others if these are `required`."""
    folders = [data_root / CASES / case for case in cases]
    present = [folder for folder in folders if is_case(folder)]
    absent = [broken(folder, "", "processed data are required") for folder in folders if required and folder not in present]
    if len(present) == len(released_cases()):
        return check(data_root)  # also compares means over all cases
    return absent + [finding for folder in present for finding in check(folder)]
