"""`neuspring fetch phystwin`: the released PhysTwin archives, from the Hugging Face hub into the folders that the readers expect.

Only the members asked for are read, by HTTP range requests: one scenario does not cost an archive, no archive is stored, and the
same command continues what was interrupted, since a file with the size and CRC-32 of its member is finished.

Verified against a local stand-in server only, with archives made to a description of the released ones: neither the real hub nor
the real archives have been met. A file that was interrupted starts again; the archive's SHA-256 is recorded, the CRC-32 of every
file is checked.
"""

from __future__ import annotations

import difflib
import json
import math
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.progress import Progress
from neuspring.core.records import now, read_json
from neuspring.data import phystwin
from neuspring.data.cases import released_cases
from neuspring.data.departure import Departure, broken
from neuspring.data.fetch.archive import CASES, Plan, archives, make_plan
from neuspring.data.fetch.hub import Hub

REPOSITORY = "Jianghanxiao/PhysTwin"
RECORD, RECORD_FORMAT = "fetched.json", 1
LOCK = ".fetch.lock"
PARTS = ("data", "results", "appearance", "images", "other")
"""Of a scenario: what the reader and check-data read; released parameters, checkpoints and predictions; released splats, with
masks and pictures of frame 0 and of the published evaluation; colour, depth and masks of every frame; what else lies with it."""
DEFAULT_PARTS = ("data", "results")
ALLOCATION = 4096
"""Bytes that file systems round a file up to."""


def fetch(
    data_root: Path,
    scenarios: Sequence[str] = (),
    parts: Sequence[str] = DEFAULT_PARTS,
    *,
    revision: str = "main",
    dry_run: bool = False,
    endpoint: str | None = None,
    say: Callable[[str], None] = print,
) -> list[Departure]:
    """Bring `parts` (of PARTS; "all": every one of these; "extra": the additional clothes) of `scenarios` (default: all 22) below
    `data_root`, and check every scenario whose processed data are there.

    Says first what is to be fetched and the space it takes; a dry run stops there. Files of another content are replaced. Returns
    what check-data finds. Writes fetched.json: commit, archives, digests. Raises InputError, also where the disk is too small, an
    archive is damaged or unsafe, or the hub does not answer.
    """
    data_root = Path(data_root)
    cases, chosen = _scenarios(scenarios), _parts(parts)
    with ExitStack() as stack:
        stack.enter_context(_alone(data_root, dry_run))
        hub = Hub(REPOSITORY, revision, endpoint)
        say(f"{hub.repository} at {hub.commit} ({hub.endpoint})")
        plans = []
        for name in archives(chosen):
            plan = make_plan(hub, name, cases, chosen, data_root)
            stack.callback(plan.remote.close)
            say(_described(plan))
            plans.append(plan)
        _check_space(data_root, plans, say)
        if dry_run:
            return []
        for plan in plans:
            _extract(plan, data_root)
            _record(data_root / RECORD, hub, plan, cases, chosen)
    return _check(data_root, cases, "data" in chosen)


def _scenarios(names: Sequence[str]) -> list[str]:
    known = list(released_cases())
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=3) or known
            raise InputError("SCENARIO", "must be one of the 22 released scenarios", name, f"Close to it: {', '.join(close)}.")
    return [name for name in known if name in names] if names else known


def _parts(names: Sequence[str]) -> set[str]:
    known = (*PARTS, "extra", "all")
    for name in names:
        if name not in known:
            raise InputError("--parts", f"must be among {', '.join(known)}", name)
    return {part for name in names for part in (PARTS if name == "all" else (name,))}


@contextmanager
def _alone(data_root: Path, dry_run: bool) -> Iterator[None]:
    """No other fetch into `data_root`; trouble with its files as InputError."""
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


def _described(plan: Plan) -> str:
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


def _check_space(data_root: Path, plans: list[Plan], say: Callable[[str], None]) -> None:
    needed = sum(math.ceil(member.info.file_size / ALLOCATION) * ALLOCATION for plan in plans for member in plan.missing)
    place = next(path for path in (data_root.absolute(), *data_root.absolute().parents) if path.exists())
    free = shutil.disk_usage(place).free
    say(f"Space needed in {data_root}: {_size(needed)}; free: {_size(free)}")
    if needed > free:
        remedy = "Free space, choose another folder, fewer scenarios or fewer --parts."
        raise InputError(data_root, f"{_size(needed)} must be free", _size(free), remedy)


def _extract(plan: Plan, data_root: Path) -> None:
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


def _record(path: Path, hub: Hub, plan: Plan, cases: list[str], chosen: set[str]) -> None:
    """Add to fetched.json what was fetched; nothing where nothing was missing and the same was recorded before."""
    entries = read_json(path, RECORD_FORMAT)["fetched"] if path.exists() else []
    what = {
        "repository": hub.repository,
        "revision": hub.commit,
        "archive": plan.file.name,
        "sha256": plan.file.sha256,
        "size": plan.file.size,
        "parts": sorted(chosen & {part for member in plan.wanted for part in member.parts}),
        "scenarios": cases,
    }
    if not plan.missing and any(what.items() <= entry.items() for entry in entries):
        return
    entry = what | {"endpoint": hub.endpoint, "date": now(), "files": len(plan.missing)}
    write_text(path, json.dumps({"format": RECORD_FORMAT, "fetched": [*entries, entry]}, indent=1) + "\n")


def _check(data_root: Path, cases: list[str], required: bool) -> list[Departure]:
    """check-data of the cases that have processed data; an error for others where these are `required`."""
    from neuspring.data import check

    folders = [data_root / CASES / case for case in cases]
    there = [folder for folder in folders if (folder / phystwin.FINAL_DATA).exists() or (folder / phystwin.SPLIT).exists()]
    lacking = [broken(folder, "", "processed data are required") for folder in folders if required and folder not in there]
    if len(there) == len(released_cases()):
        return check.check(data_root)  # compares means over all cases, too
    return lacking + [departure for folder in there for departure in check.check(folder)]
