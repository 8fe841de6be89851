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
import json
import math
import os
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

from filelock import FileLock, Timeout

# The library reads this when it is first imported.
os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")

from huggingface_hub import HfApi, HfFileSystem, errors, hf_hub_url
from huggingface_hub.hf_file_system import HfFileSystemFile
from huggingface_hub.utils import build_hf_headers, hf_raise_for_status, http_stream_backoff, httpx

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.findings import Finding, broken
from neuspring.core.records import now, read_json
from neuspring.core.text import Progress
from neuspring.core.version import __version__
from neuspring.intake import phystwin
from neuspring.intake.check import check_layout, is_case
from neuspring.intake.phystwin import released_cases

REPOSITORY = "Jianghanxiao/PhysTwin"
RECORD, FETCHED_FORMAT = "fetched.json", 1
LOCK = ".fetch.lock"
PARTS = ("data", "results", "appearance", "images", "other")
"""Parts of a scenario. data: what the reader and check-data read. results: released parameters, checkpoints and predictions.
appearance: released splats, with masks and pictures of frame 0 and of the published evaluation. images: color, depth and masks of
every frame. other: everything else."""
DEFAULT_PARTS = ("data", "results")
ALLOCATION = 4096
"""File systems round the size of a file up to a multiple of this, bytes."""
CASES = "data/different_types"
"""Place of processed cases below data_root."""
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


def fetch(
    data_root: Path,
    scenarios: Sequence[str] = (),
    parts: Sequence[str] = DEFAULT_PARTS,
    *,
    revision: str = "main",
    dry_run: bool = False,
    endpoint: str | None = None,
    say: Callable[[str], None] = print,
) -> list[Finding]:
    """Fetch `parts` of `scenarios` (default: all 22) below `data_root`, and check every scenario whose processed data are there.

    `parts` are of PARTS; "all" stands for every one of these, "extra" for the additional clothes. What will be fetched and the
    space it takes is said first; a dry run stops there. Files of other content are replaced. fetched.json records commit, archives
    and digests. Returns what `check-data` finds. Raises InputError, also if the disk is too small, an archive is damaged or unsafe,
    or the hub does not answer.
    """
    data_root = Path(data_root)
    released = list(released_cases())
    for name in scenarios:
        if name not in released:
            close = difflib.get_close_matches(name, released, n=3) or released
            raise InputError("SCENARIO", "must be one of the 22 released scenarios", name, f"Close to it: {', '.join(close)}.")
    choices = (*PARTS, "extra", "all")
    for name in parts:
        if name not in choices:
            raise InputError("--parts", f"must be among {', '.join(choices)}", name)
    cases = [name for name in released if name in scenarios or not scenarios]
    part_names = {part for name in parts for part in (PARTS if name == "all" else (name,))}
    with ExitStack() as stack:
        stack.enter_context(_alone(data_root, dry_run))
        hub = Hub(REPOSITORY, revision, endpoint)
        say(f"{hub.repository} at {hub.commit} ({hub.endpoint})")
        plans = []
        for name in dict.fromkeys(archive for archive, contents in TREES.values() if part_names & set(contents)):
            if name not in hub.files:
                there = ", ".join(sorted(hub.files)) or "nothing"
                raise InputError(f"{hub.repository} at {hub.commit}", f"{name} is required", there, "Choose another --revision.")
            remote = stack.enter_context(hub.open(hub.files[name]))
            plans.append(make_plan(hub.files[name], remote, cases, part_names, data_root))
            say(plans[-1].text)
        needed = sum(math.ceil(member.info.file_size / ALLOCATION) * ALLOCATION for plan in plans for member in plan.missing)
        place = next(path for path in (data_root.absolute(), *data_root.absolute().parents) if path.exists())
        free = shutil.disk_usage(place).free
        say(f"Space needed in {data_root}: {_size(needed)}; free: {_size(free)}")
        if needed > free:
            remedy = "Free space, choose another folder, fewer scenarios or fewer --parts."
            raise InputError(data_root, f"{_size(needed)} must be free", _size(free), remedy)
        if dry_run:
            return []
        for plan in plans:
            _extract(plan, data_root)
            _record(data_root / RECORD, hub, plan, cases, part_names)
    folders = [data_root / CASES / case for case in cases]
    present = [folder for folder in folders if is_case(folder)]
    if len(present) == len(released):
        return check_layout(data_root)  # also compares means over all cases
    absent = [folder for folder in folders if "data" in part_names and folder not in present]
    findings = [broken(folder, "", "processed data are required") for folder in absent]
    return findings + [finding for folder in present for finding in check_layout(folder)]


@contextmanager
def _alone(data_root: Path, dry_run: bool) -> Iterator[None]:
    """Lock `data_root` against other fetches. Raises trouble with its files as InputError."""
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


def _size(count: int) -> str:
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.1f} {unit}"
    return f"{count} B"


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
    entries = read_json(path, FETCHED_FORMAT)["fetched"] if path.exists() else []
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
    write_text(path, json.dumps({"format": FETCHED_FORMAT, "fetched": [*entries, entry]}, indent=1) + "\n")


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
    """Files to extract from one archive."""

    file: HubFile
    archive: zipfile.ZipFile
    wanted: list[ArchiveMember]
    """The files that were asked for."""
    missing: list[ArchiveMember]
    """Those that are not on disk in the archive's state, in the archive's order."""
    text: str
    """Summary for the user."""


def make_plan(file: HubFile, remote: RemoteFile, cases: list[str], parts: set[str], data_root: Path) -> FetchPlan:
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
    there = [member for member in wanted if (data_root / member.path).exists()]
    progress, finished = Progress(f"{file.name}: checking files that are there", len(there)), set()
    for count, member in enumerate(there, start=1):
        if _is_finished(data_root / member.path, member.info):
            finished.add(member.path)
        progress.update(count)
    missing = sorted((m for m in wanted if m.path not in finished), key=lambda member: member.info.header_offset)

    cost = sum(member.info.compress_size for member in missing)
    differing = len(there) - len(finished)
    replaced = f", {differing} with other content on disk are replaced" if differing else ""
    lines = [
        f"{file.name}: {len(wanted)} of {len(files)} files asked for, {len(finished)} are there{replaced}; {_size(cost)} of "
        f"{_size(file.size)} to fetch, {_size(sum(member.info.file_size for member in missing))} on disk"
    ]
    # What `other` and `extra` should hold is unknown.
    present = {(member.tree, member.case, part) for member in wanted for part in member.parts}
    for tree, (name, contents) in TREES.items():
        for part in contents:
            without = [case for case in cases if (tree, case, part) not in present]
            if name == file.name and part in parts - {"other", "extra"} and without:
                lines.append(f"{file.name} has no {part} ({tree}) of {', '.join(without)}")
    return FetchPlan(file=file, archive=archive, wanted=wanted, missing=missing, text="\n".join(lines))


def _wanted(name: str, files: list[zipfile.ZipInfo], cases: list[str], parts: set[str]) -> list[ArchiveMember]:
    for info in files:
        path = info.filename
        faults = {
            "an absolute path": path.startswith(("/", "\\")) or re.match(r"[A-Za-z]:", path) is not None,
            "a path with ..": ".." in re.split(r"[/\\]", path),
            "a path with a backslash or control character": re.search(r"[\\\x00-\x1f]", path) is not None,
        }
        _refuse(name, info, faults)
    trees = [tree for tree, (archive, _) in TREES.items() if archive == name]
    members = [member for info in files if (member := _locate(info, trees)) is not None]
    # One folder per tree counts: the one with the tree's name, else with most files, else with the shortest path.
    counts = Counter((member.tree, member.prefix) for member in members)
    prefixes = dict(sorted(counts, key=lambda place: (_is_named(*place), counts[place], -len(place[1]))))
    # In a zip archive, the last of several entries with one name counts.
    located = {member.path: member for member in members if member.prefix == prefixes[member.tree]}.values()
    wanted = [member for member in located if member.parts & parts and member.case in ("", *cases)]
    if not wanted:
        folders = sorted({"/".join(info.filename.split("/")[:3]) for info in files})
        rule = f"must hold the parts {', '.join(sorted(parts))} of {', '.join(cases)}"
        raise InputError(name, rule, "none of them", f"First paths in the archive: {', '.join(folders[:8]) or 'none'}.")
    for member in wanted:
        special = stat.S_IFMT(member.info.external_attr >> 16) not in (0, stat.S_IFREG)
        _refuse(name, member.info, {"a link or special file": special, "an encrypted file": bool(member.info.flag_bits & 1)})
    return wanted


def _locate(info: zipfile.ZipInfo, trees: list[str]) -> ArchiveMember | None:
    """The place where a file belongs: below the name of a case, in a folder with the name of a tree; None elsewhere."""
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


def _is_named(tree: str, prefix: str) -> bool:
    return tree.rpartition("/")[2] == prefix.rpartition("/")[2]


def _refuse(name: str, info: zipfile.ZipInfo, faults: dict[str, bool]) -> None:
    if fault := next((fault for fault, holds in faults.items() if holds), None):
        rule = "an archive may hold plain files at relative paths only"
        raise InputError(f"{name}: {info.filename!r}", rule, fault, "Nothing was extracted. Choose another --revision.")


def _is_finished(path: Path, info: zipfile.ZipInfo) -> bool:
    if not path.is_file() or path.stat().st_size != info.file_size:
        return False
    crc = 0
    with path.open("rb") as stream:
        while block := stream.read(2**20):
            crc = zlib.crc32(block, crc)
    return crc == info.CRC


TIMEOUT = 30.0
"""Seconds without a byte after which a request has failed."""
BLOCK = 2**22
"""Bytes that are read ahead in one range request; so many may be read in vain where the next file lies elsewhere."""


@dataclass(frozen=True)
class HubFile:
    """A file, as the hub declares it."""

    name: str
    size: int
    """Bytes."""
    sha256: str
    """SHA-256 of the whole file; empty where the hub gives none."""


class RemoteFile(HfFileSystemFile):
    """A binary file of the hub, for `zipfile`. The library reads ahead, and retries lost connections."""

    def _fetch_range(self, start: int, end: int) -> bytes:
        url = self.url()
        with _explained(url, self.path):
            content = bytes(super()._fetch_range(start, end))
        if len(content) != end - start:
            raise _broken_off(url, f"{len(content)} of {end - start} bytes")
        return content


class Hub:
    """One data set repository at one commit. Sends no telemetry, and a token only if HF_TOKEN holds one.

    Every failure of the hub or of the network raises InputError with the next move, here and in every later call.
    """

    def __init__(self, repository: str, revision: str, endpoint: str | None = None) -> None:
        token = os.environ.get("HF_TOKEN") or False
        api = HfApi(endpoint=endpoint, token=token, library_name="neuspring", library_version=__version__)
        self.repository, self.endpoint = repository, api.endpoint
        self._headers = build_hf_headers(token=token, library_name="neuspring", library_version=__version__)
        self._system = HfFileSystem(endpoint=endpoint, token=token, skip_instance_cache=True)
        with _explained(f"{self.endpoint}: {repository}", revision):
            info = api.dataset_info(repository, revision=revision, files_metadata=True, timeout=TIMEOUT)
        self.commit = str(info.sha)
        self.files = {
            file.rfilename: HubFile(file.rfilename, int(file.size or 0), file.lfs.sha256 if file.lfs else "")
            for file in info.siblings or []
        }

    def open(self, file: HubFile) -> RemoteFile:
        """Open a file for reading. Checks that the server has it in the declared size and serves parts of it."""
        # The library would read a whole archive from a server that ignores ranges; here only the head of an answer is read.
        url = hf_hub_url(self.repository, file.name, repo_type="dataset", revision=self.commit, endpoint=self.endpoint)
        headers = self._headers | {"Range": "bytes=0-0", "Accept-Encoding": "identity"}
        with _explained(url, self.commit), http_stream_backoff("GET", url, headers=headers, timeout=TIMEOUT) as response:
            hf_raise_for_status(response)
            status, extent = response.status_code, response.headers.get("Content-Range", "")
        if status != 206:
            remedy = "Choose another server with HF_ENDPOINT."
            raise InputError(url, "the server must serve parts of a file (HTTP status 206)", status, remedy)
        if extent.rpartition("/")[2] != str(file.size):
            remedy = "Run the same command again, or choose another server with HF_ENDPOINT."
            raise InputError(url, f"the hub declares {file.size} bytes", extent or "no size", remedy)
        path = f"datasets/{self.repository}@{self.commit}/{file.name}"
        with _explained(path, self.commit):
            return RemoteFile(self._system, path, size=file.size, block_size=BLOCK, cache_type="readahead")


@contextmanager
def _explained(where: str, revision: str) -> Iterator[None]:
    """Raise failures of the hub and of the network as InputError."""
    try:
        yield
    except InputError:
        raise
    except errors.OfflineModeIsEnabled as error:
        remedy = "Unset it (or TRANSFORMERS_OFFLINE)."
        raise InputError("HF_HUB_OFFLINE", "fetching needs the hub", "offline mode", remedy) from error
    except errors.RevisionNotFoundError as error:
        rule = f"must be a branch, tag or commit of {where}"
        raise InputError("--revision", rule, revision, "Leave it out for the newest state.") from error
    except errors.HfHubHTTPError as error:
        status = error.response.status_code
        if status in (401, 403, 404):
            remedy = "Check HF_ENDPOINT; if the hub asks for a login, set HF_TOKEN to a token that may read."
            raise InputError(where, "must be readable at the hub", f"HTTP status {status}", remedy) from error
        raise _broken_off(where, f"HTTP status {status}") from error
    # RuntimeError: a failed connection of one thread closes the client that all threads share. ValueError: not JSON.
    except (httpx.HTTPError, httpx.InvalidURL, OSError, RuntimeError, ValueError, KeyError) as error:
        raise _broken_off(where, f"{type(error).__name__}: {error}".partition("\n")[0]) from error


def _broken_off(where: str, received: str) -> InputError:
    remedy = "Once the network is back, the same command continues; HF_ENDPOINT=<address> names another server (a mirror)."
    return InputError(where, "the hub must answer", received, remedy)
