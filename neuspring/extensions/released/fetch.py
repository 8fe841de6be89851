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
import os
import re
import shutil
import stat
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

# The library reads this when it is first imported.
os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")

from huggingface_hub import HfApi, HfFileSystem
from huggingface_hub.hf_api import DatasetInfo, RepoSibling
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
BLOCK = 2**22
"""Bytes that are read ahead in one range request; so many may be read in vain where the next file lies elsewhere."""
TIMEOUT = 30.0
"""Seconds without a byte after which a request has failed."""
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
_LEADS_ELSEWHERE = re.compile(r"/|[A-Za-z]:|.*[\\\x00-\x1f]|(.*/)?\.\.(/|$)")


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
    data_root, released = Path(data_root), list(released_cases())
    for where, names, known in (("SCENARIO", scenarios, released), ("--parts", parts, [*PARTS, "extra", "all"])):
        for name in names:
            if name not in known:
                close = difflib.get_close_matches(name, known) or known
                raise InputError(where, f"must be among {', '.join(known)}", name, f"Close to it: {', '.join(close)}.")
    cases = [name for name in released if name in scenarios or not scenarios]
    chosen = {part for name in parts for part in (PARTS if name == "all" else (name,))}
    with ExitStack() as stack:
        token = os.environ.get("HF_TOKEN") or False
        api = HfApi(endpoint=endpoint, token=token, library_name="neuspring", library_version=__version__)
        stack.enter_context(_explained(data_root, api.endpoint))
        if not dry_run:
            data_root.mkdir(parents=True, exist_ok=True)
            stack.enter_context(FileLock(data_root / LOCK, timeout=0))
        info = api.dataset_info(REPOSITORY, revision=revision, files_metadata=True, timeout=TIMEOUT)
        say(f"{REPOSITORY} at {info.sha} ({api.endpoint})")
        files = {file.rfilename: file for file in info.siblings or []}
        system = HfFileSystem(endpoint=endpoint, token=token, skip_instance_cache=True)
        plans: list[tuple[RepoSibling, zipfile.ZipFile, dict[str, zipfile.ZipInfo]]] = []
        for name in dict.fromkeys(archive for archive, contents in TREES.values() if chosen & set(contents)):
            if name not in files:
                rule = f"{name} is required"
                raise InputError(f"{REPOSITORY} at {info.sha}", rule, ", ".join(files), "Choose another --revision.")
            path = f"datasets/{REPOSITORY}@{info.sha}/{name}"
            remote = stack.enter_context(system.open(path, block_size=BLOCK, cache_type="readahead"))
            _require_ranges(remote, build_hf_headers(token=token), files[name].size or 0)
            try:
                archive = zipfile.ZipFile(remote)
            except (zipfile.BadZipFile, NotImplementedError) as error:
                raise InputError(name, "must be a zip archive", str(error), "Choose another --revision.") from error
            wanted = _wanted(name, archive, cases, chosen)
            missing = {path: member for path, member in wanted.items() if not _is_finished(data_root / path, member)}
            differing = sum((data_root / path).exists() for path in missing)
            fetched = sum(member.compress_size for member in missing.values())
            say(
                f"{name}: {len(wanted)} files asked for, {len(wanted) - len(missing)} are there, {differing} with other content on "
                f"disk are replaced; {_size(fetched)} of {_size(files[name].size or 0)} to fetch"
            )
            plans.append((files[name], archive, missing))
        needed = sum(member.file_size for *_, missing in plans for member in missing.values())
        free = shutil.disk_usage(next(path for path in (data_root, *data_root.absolute().parents) if path.exists())).free
        say(f"Space needed in {data_root}: {_size(needed)}; free: {_size(free)}")
        if needed > free:
            remedy = "Free space, choose another folder, fewer scenarios or fewer --parts."
            raise InputError(data_root, f"{_size(needed)} must be free", _size(free), remedy)
        if dry_run:
            return []
        for file, archive, missing in plans:
            progress = Progress(f"{file.rfilename}: files", len(missing))
            # In the archive's order, so that what is read ahead is of use.
            for count, path in enumerate(sorted(missing, key=lambda path: missing[path].header_offset), start=1):
                _extract(file.rfilename, archive, missing[path], data_root / path)
                progress.update(count)
            held = {part for name, contents in TREES.values() if name == file.rfilename for part in contents}
            asked = {"parts": sorted(chosen & held), "scenarios": cases, "endpoint": api.endpoint}
            _record(data_root / RECORD, info, file, asked, len(missing))
    folders = [data_root / CASES / case for case in cases]
    present = [folder for folder in folders if is_case(folder)]
    if len(present) == len(released):
        return check_layout(data_root)  # also compares means over all cases
    absent = [folder for folder in folders if "data" in chosen and folder not in present]
    findings = [broken(folder, "", "processed data are required") for folder in absent]
    return findings + [finding for folder in present for finding in check_layout(folder)]


@contextmanager
def _explained(data_root: Path, endpoint: str) -> Iterator[None]:
    """Raise failures of the hub, of the network and of the disk as InputError."""
    try:
        yield
    except Timeout as error:
        raise InputError(data_root, "one fetch at a time may write here", "another is at work", "Wait for it to end.") from error
    except (httpx.HTTPError, httpx.InvalidURL, OSError, RuntimeError, json.JSONDecodeError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            remedy = "Free space or fix permissions; the same command continues."
            raise InputError(error.filename or data_root, "must be readable and writable", error.strerror, remedy) from error
        # RuntimeError: the library closes its client after a failed connection.
        remedy = (
            "Check the network, --revision, HF_ENDPOINT=<address> (another server, a mirror), HF_TOKEN (a token that may read) and "
            "that HF_HUB_OFFLINE is not set; the same command continues."
        )
        raise InputError(endpoint, "the hub must answer", f"{type(error).__name__}: {error}".partition("\n")[0], remedy) from error


def _require_ranges(remote: HfFileSystemFile, headers: dict[str, str], size: int) -> None:
    """Refuse a server that ignores ranges, from the head of its answer: the library would read a whole archive for each."""
    headers = headers | {"Range": "bytes=0-0", "Accept-Encoding": "identity"}
    with http_stream_backoff("GET", remote.url(), headers=headers, timeout=TIMEOUT) as response:
        hf_raise_for_status(response)
        received = f"{response.status_code} {response.headers.get('Content-Range', '')}"
    if received != (required := f"206 bytes 0-0/{size}"):
        rule = f"the server must serve parts of a file of the declared size (HTTP {required})"
        raise InputError(remote.url(), rule, received, "Choose another server with HF_ENDPOINT.")


def _wanted(name: str, archive: zipfile.ZipFile, cases: list[str], parts: set[str]) -> dict[str, zipfile.ZipInfo]:
    """Path below data_root -> file of the archive. Raises InputError if there is none, or if one is unsafe, wanted or not."""
    files = [info for info in archive.infolist() if not info.is_dir()]
    trees = [tree for tree, (holder, _) in TREES.items() if holder == name]
    places = [(*place, info) for info in files if (place := _place(info.filename, trees))]
    # One folder per tree counts: the one with the tree's name, else the one with most files.
    counts = Counter((tree, prefix) for tree, prefix, *_ in places)
    prefixes = dict(sorted(counts, key=lambda folder: (_is_named(*folder), counts[folder])))
    # In a zip archive, the last of several entries with one name counts.
    wanted = {
        "/".join(filter(None, (tree, case, rest))): info
        for tree, prefix, case, rest, info in places
        if prefix == prefixes[tree] and case in ("", *cases) and _parts(tree, rest) & parts
    }
    unsafe = [info for info in files if _LEADS_ELSEWHERE.match(info.filename)]
    regular = (0, stat.S_IFREG)
    unsafe += [i for i in wanted.values() if i.flag_bits & 1 or stat.S_IFMT(i.external_attr >> 16) not in regular]
    if unsafe:
        rule = "an archive may hold plain files at relative paths only, no links, and none encrypted"
        raise InputError(name, rule, unsafe[0].filename, "Nothing was extracted. Choose another --revision.")
    if not wanted:
        folders = sorted({"/".join(info.filename.split("/")[:3]) for info in files})
        rule = f"must hold the parts {', '.join(sorted(parts))} of {', '.join(cases)}"
        raise InputError(name, rule, "none of them", f"First paths in the archive: {', '.join(folders[:8]) or 'none'}.")
    return wanted


def _place(path: str, trees: list[str]) -> tuple[str, str, str, str] | None:
    """The place where a file belongs, below the name of a case in a folder with the name of a tree: the tree, the folder of the
    cases in the archive, the case (empty for what belongs to no scenario), the path below it. None for a file that has none."""
    names = [name for name in path.split("/") if name not in ("", ".")]
    if trees == [EXTRA]:
        start = names.index(EXTRA) + 1 if EXTRA in names[:-1] else 0
        return EXTRA, "/".join(names[:start]), "", "/".join(names[start:])
    for place, case in enumerate(names[:-1]):
        if case in released_cases():
            prefix = "/".join(names[:place])
            # An archive of one tree may call its folder what it likes.
            named = trees if len(trees) == 1 else [tree for tree in trees if _is_named(tree, prefix)]
            return (named[0], prefix, case, "/".join(names[place + 1 :])) if named else None
    return None


def _parts(tree: str, rest: str) -> set[str]:
    """The parts that a file belongs to; it may belong to two."""
    if tree != CASES:
        return set(TREES[tree][1])
    return {name for name, pattern in (("data", _DATA), ("images", _IMAGES)) if pattern.fullmatch(rest)} or {"other"}


def _is_named(tree: str, prefix: str) -> bool:
    return tree.rpartition("/")[2] == prefix.rpartition("/")[2]


def _is_finished(path: Path, info: zipfile.ZipInfo) -> bool:
    return path.is_file() and path.stat().st_size == info.file_size and zlib.crc32(path.read_bytes()) == info.CRC


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB"


def _extract(name: str, archive: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path) -> None:
    part = target.with_name(f".{target.name}.part")
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        with archive.open(info) as source, part.open("wb") as sink:
            shutil.copyfileobj(source, sink, 2**20)
        part.replace(target)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError) as error:
        remedy = "Run the same command again; if it repeats, the archive itself is damaged: choose another --revision."
        raise InputError(f"{name}: {info.filename}", "must be what the archive declares", str(error), remedy) from error
    finally:
        part.unlink(missing_ok=True)


def _record(path: Path, info: DatasetInfo, file: RepoSibling, asked: dict[str, Any], count: int) -> None:
    """Add an entry to fetched.json, unless nothing was missing and the same is recorded already."""
    entries = read_json(path, FETCHED_FORMAT)["fetched"] if path.exists() else []
    content: dict[str, Any] = {"repository": REPOSITORY, "revision": info.sha, "archive": file.rfilename, "size": file.size}
    content |= {"sha256": file.lfs.sha256 if file.lfs else ""} | asked
    if count or not any(content.items() <= entry.items() for entry in entries):
        entries.append(content | {"date": now(), "files": count})
        write_text(path, json.dumps({"format": FETCHED_FORMAT, "fetched": entries}, indent=1) + "\n")
