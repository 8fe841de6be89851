"""Which splats belong to a run: most methods share those of their seed, some have their own."""

from __future__ import annotations

from pathlib import Path

from neuspring.core.records import StageRecord, digest_file

APPEARANCE, RENDER = "appearance.json", "render.json"


def splats_file(folder: Path) -> Path | None:
    """The splats of the pictures of a run's folder <scenario>/<method>/<seed>, else those of its seed; None: there are none.

    Raises InputError for a damaged record, or where the splats are not those that their record names.
    """
    scenario, seed = folder.parent.parent, folder.name
    records = sorted(scenario.glob(f"appearance*/*/{APPEARANCE}"))
    wanted = StageRecord.load(folder / RENDER).inputs.get("appearance") if (folder / RENDER).is_file() else None
    if wanted is not None:
        records = [path for path in records if digest_file(path) == wanted]
    else:
        records = [path for path in records if path.parent.name == seed and path.parent.parent.name == "appearance"]
    for path in records:
        record = StageRecord.load(path)
        if record.status == "ok":
            return record.file("splats", path)
    return None
