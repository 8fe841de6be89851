"""`neuspring fetch phystwin`: the released PhysTwin archives, from the Hugging Face hub into the folders that the readers expect.

Only the files that were asked for are read, by HTTP range requests: one scenario does not cost an archive, and no archive is
stored. The same command continues an interrupted fetch: a file with the size and CRC-32 of its archive member is finished, any
other starts again. The archive's SHA-256 is recorded, the CRC-32 of every file is checked.

It is tested against a local stand-in server with archives in the described layout. Neither the real hub nor the real archives
have been met.
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
from neuspring.data.cases import released_cases
from neuspring.data.check import check_layout, is_case
from neuspring.data.departure import Departure, broken
from neuspring.data.fetch.archive import CASES, Plan, archives, make_plan
from neuspring.data.fetch.hub import Hub

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
    check: Callable[[Path], list[Departure]] = check_layout,
) -> list[Departure]:
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


def _record(path: Path, hub: Hub, plan: Plan, cases: list[str], parts: set[str]) -> None:
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


def _check(data_root: Path, cases: list[str], required: bool, check: Callable[[Path], list[Departure]]) -> list[Departure]:
    """Check the cases that have processed data; an error for others if these are `required`."""
    folders = [data_root / CASES / case for case in cases]
    present = [folder for folder in folders if is_case(folder)]
    absent = [broken(folder, "", "processed data are required") for folder in folders if required and folder not in present]
    if len(present) == len(released_cases()):
        return check(data_root)  # also compares means over all cases
    return absent + [departure for folder in present for departure in check(folder)]
