"""What each part of a rod brings on cables: fits with and without it, judged on training recordings that no fit has seen.

    python workflow/scripts/rod_parts.py DATA_SET CABLE OUTPUT.csv [--clips 8] [--threads 2] [--parts all,straight,...]

DATA_SET is DEFORM's data set (config/data/deform.yaml). Fits take that many training recordings, evenly spaced, and are judged on
every fourth, which no fit takes; evaluation recordings are not opened. Prints L1, mm (mean, median, worst recording) and seconds.
Finished rows of OUTPUT.csv are kept.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring import config
from neuspring.core.device import start_warp
from neuspring.scenes import mocap
from neuspring.scenes.sources import scenario_rows
from neuspring.scores.metrics import deform_l1
from neuspring.twin.rod_fit import fit_rod, search_rod
from neuspring.twin.rollout import initial_velocity, roll_out
from neuspring.twin.transfer import move

PARTS: dict[str, tuple[dict[str, Any], int | None]] = {
    "all": ({}, None),
    "straight": ({"fit": {"rod": {"curvature": "straight"}}}, None),
    "one curvature": ({"fit": {"rod": {"curvature": "constant"}}}, None),
    "curvature between knots": ({"fit": {"rod": {"curvature": "knots"}}}, None),
    "stiffness between knots": ({"fit": {"rod": {"stiffness": "knots"}}}, None),
    "stiffness free": ({"fit": {"rod": {"stiffness": "free"}}}, None),
    "markers on the line": ({"fit": {"rod": {"markers": False}}}, None),
    "roll half a turn away": ({"rod": {"axes": [[1.0, 0.0, 0.0]]}}, None),
    "hardly any inner damping": ({"rod": {"damping": 1e-6}}, None),
    "light markers": ({"rod": {"marker_mass": 1e-6}}, None),
    "60 frames": ({"fit": {"rod": {"horizons": [60]}}}, None),
    "60 and 150 frames": ({"fit": {"rod": {"horizons": [60, 150]}}}, None),
    "2 clips": ({}, 2),
    "4 clips": ({}, 4),
    "16 clips": ({}, 16),
    "32 clips": ({}, 32),
}
"""Part -> what differs: settings, and the number of recordings."""


def judged(cable: str, data: Path, clips: int, changes: dict[str, Any], threads: int) -> dict[str, Any]:
    """Errors, mm, of a fit on recordings that it has not seen, and its seconds."""
    values = config.read_yaml(Path("config/data/deform.yaml"))
    values |= {"data_root": str(data), "deform": {}}
    config.merge(values, changes)
    settings = config.parse(config.Config, values, "rod_parts")
    numbers = sorted(int(file.stem) for file in (data / cable / "train").glob("*.pkl"))
    names = [f"{cable}_train_{number}" for number in numbers]
    others, rest = names[1::4], [name for place, name in enumerate(names) if place % 4 != 1]
    pool = [rest[place] for place in np.linspace(0, len(rest) - 1, clips).astype(int)]
    rows = scenario_rows(settings, also=[*pool, *others])

    def read(name: str) -> Any:
        return mocap.read(rows[name], data / rows[name].path, settings.mocap)

    seen, began = [read(name) for name in pool], time.perf_counter()
    start = search_rod(seen[0], seen[1:], settings, threads=threads).twin
    twin = fit_rod(seen[0], seen[1:], start, settings.fit.rod, threads=threads).twin
    seconds, errors = time.perf_counter() - began, {}
    for observations in map(read, others):
        velocity = initial_velocity(observations, twin.simulation.initial_velocity)
        found = roll_out(move(twin, observations)[0], observations.controller_points, velocity=velocity)
        errors[observations.scenario.name] = 1e3 * float(np.mean(deform_l1(found.positions, observations)[1:]))
    worst = max(errors, key=errors.__getitem__)
    mm = np.array(list(errors.values()))
    return {"l1": mm.mean(), "median": np.median(mm), "worst": mm.max(), "worst clip": worst, "clips": len(mm), "seconds": seconds}


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser()
    parser.add_argument("data", type=Path)
    parser.add_argument("cable")
    parser.add_argument("output", type=Path)
    parser.add_argument("--clips", type=int, default=8)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--parts", default=",".join(PARTS))
    asked = parser.parse_args()
    start_warp()
    rows = pd.read_csv(asked.output).to_dict("records") if asked.output.exists() else []
    for part in asked.parts.split(","):
        if any((row["cable"], row["part"]) == (asked.cable, part) for row in rows):
            continue
        changes, clips = PARTS[part]
        rows.append(
            {"cable": asked.cable, "part": part} | judged(asked.cable, asked.data, clips or asked.clips, changes, asked.threads)
        )
        pd.DataFrame(rows).to_csv(asked.output, index=False, float_format="%.3f")
        print(rows[-1], flush=True)


if __name__ == "__main__":
    main()
