"""A results folder as the workflow leaves it, with invented numbers: for tests of the report."""

import html
import itertools
import os
import re
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from neuspring import config
from neuspring.core.artifacts import Trajectory
from neuspring.core.files import write_table, write_text
from neuspring.core.job_records import JobRecord
from neuspring.core.records import StageRecord, digest_file
from neuspring.draw.video import Video
from neuspring.scores.metrics import METRICS, SCORE_COLUMNS
from tests.support import scenarios
from tests.support.runs import run_record

FRAMES, TRAIN, RATE = 20, 14, 30.0
SEARCHES = {"search_only": "uniform", "baseline": "uniform", "phystwin": "uniform", "model_b": "uniform"}
"""All other methods start from a piecewise search."""
LEVELS = {"chamfer": 0.006, "track_error": 0.010, "psnr": 28.0, "ssim": 0.94, "iou": 0.84}
SCORED = ("chamfer", "track_error")


def make(
    results,
    scenarios=("rope", "cloth"),
    methods=("baseline", "neuspring"),
    seeds=(0, 1),
    *,
    source="synthetic",
    pictures=True,
    curves=True,
    nodes=30,
    commit="0123456789abcdef",
):
    """Finished runs of every combination; returns `results`."""
    drawn = _pictures(results / "drawn") if pictures else {}
    for scenario in scenarios:
        seen = observations(scenario, source, nodes)
        seen.save(results / scenario / "observations.npz")
        for method in methods:
            for seed in seeds:
                write_run(results, seen, method, seed, drawn, curves=curves, commit=commit)
    return results


def write_run(results, seen, method, seed, drawn, *, curves=True, **changes):
    """One finished run with the records of its stages; `changes` replace entries of run.json. Returns its path.

    Without `curves` it has no histories and no trajectory.
    """
    scenario = seen.scenario
    rng = np.random.default_rng(zlib.crc32(f"{scenario.name} {method} {seed}".encode()))
    row = SEARCHES.get(method, "piecewise_5")
    folder, search = results / scenario.name / method / str(seed), results / scenario.name / f"search-{row}" / str(seed)
    for place in (folder, search):
        place.mkdir(parents=True, exist_ok=True)
    chosen = config.plain(config.Config(fit=config.Fit(epochs=5), search=config.Search(rollouts=30)))
    own = {name: chosen[name] for name in ("simulation", "losses", "released_quirks")}
    settings = {"search": own | {"search": chosen["search"]}, "rollout": {}}
    write_history(search / "history.parquet", "best_cost", np.minimum.accumulate(rng.uniform(1e-5, 2e-3, 30)))
    StageRecord(stage="search", status="ok", settings=settings["search"]).save(search / "search.json")
    records, histories = {"search": search / "search.json"}, {"search": search / "history.parquet"}
    if method != "search_only":
        settings["fit"] = own | {"fit": chosen["fit"]}
        write_history(folder / "history.parquet", "loss", 1e-4 * np.exp(-np.arange(5.0)))
        StageRecord(stage="fit", status="ok", settings=settings["fit"]).save(folder / "fit.json")
        records["fit"], histories["fit"] = folder / "fit.json", folder / "history.parquet"
    named = {}
    if curves:
        positions = seen.nodes + 1e-3 * rng.normal(size=(FRAMES, 1, 3)).cumsum(axis=0)
        Trajectory(positions=positions, frame_count=FRAMES).save(folder / "trajectory.npz")
        named = {"trajectory": ["trajectory.npz", digest_file(folder / "trajectory.npz")]}
    StageRecord(stage="rollout", status="ok", files=named).save(folder / "rollout.json")
    records["rollout"] = folder / "rollout.json"
    _scores(scenario, method, seed, bool(drawn), rng).to_parquet(folder / "scores.parquet", index=False)
    for name, data in drawn.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
    names = list(drawn)
    record = run_record(
        scenario=scenario.name,
        method=method,
        seed=seed,
        source=scenario.source,
        category=scenario.category,
        run_key=digest_file(folder / "scores.parquet").rpartition(":")[2],
        device="cuda:0",
        variant={"search": row, "clusters": 5, "fit": "field", "horizon": 10},
        settings=settings,
        histories={name: _relative(path, folder) for name, path in histories.items() if curves},
        timings={name: float(rng.uniform(60, 600)) for name in records} | {"score": 2.0},
        peak_memory_mb=dict.fromkeys(records, 900.0),
        artifacts={
            "records": [_relative(path, folder) for path in records.values()],
            "plots": [name for name in names if name.startswith("plots/")],
            "images": [name for name in names if not name.startswith("plots/")],
        },
    )
    replace(record, **changes).save(folder / "run.json")
    return folder / "run.json"


def write_jobs(results, scenarios, methods, seeds, *, never=25):
    """Job records of fits on a GPU; every `never`-th failed."""
    for count, (scenario, method, seed) in enumerate(itertools.product(scenarios, methods, seeds)):
        save_job(results, f"fit/{scenario}/{method}/{seed}", failed=count % never == never - 1, seconds=200.0 + 37 * (count % 7))


def save_job(results, name, *, failed=False, **changes):
    """A job record and its log."""
    values = {"started": "2026-01-05T00:00:00+00:00", "seconds": 5.0, "host": "server", "devices": ["0"]}
    values |= {"device_names": ["NVIDIA H100"], "peak_memory_mb": 2100.0, "log": f"jobs/{name}/0.log"} | changes
    if failed:
        values |= {"outcome": "failed", "message": "CUDA error: out of memory"}
    folder = results / "jobs" / name
    JobRecord(rule=name.partition("/")[0], name=name, **values).save(folder / ("failed.json" if failed else "0.json"))
    write_text(folder / "0.log", "what it said\n")


def observations(name, source, nodes):
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    category = name.removeprefix("synthetic_").split("_")[-1] if not name[-1].isdigit() else name.split("_")[-2]
    points = rng.uniform(-0.1, 0.1, (nodes, 3)) + np.zeros((FRAMES, 1, 1))
    about = {"name": name, "source": source, "category": category, "train_end": TRAIN, "frame_rate": RATE}
    return scenarios.seen(points, points[:, :1], about, tracks=points[:, :5])


def _scores(scenario, method, seed, pictured, rng):
    better = 0.85 if method == "neuspring" else 1.0
    rows = []
    for task, factor, frames in (("reconstruction", 1.0, TRAIN - 1), ("future", 1.8, FRAMES - TRAIN)):
        for metric, level in LEVELS.items():
            if metric in SCORED:
                value = level * factor * better * rng.uniform(0.8, 1.25)
            elif pictured:
                value = level - 0.02 * level * factor * better * rng.uniform(0.8, 1.25)
            else:
                continue
            rows.append((scenario.name, scenario.category, method, seed, task, metric, value, METRICS[metric].unit, frames))
    return pd.DataFrame(rows, columns=list(SCORE_COLUMNS))


def write_history(path, metric, values):
    write_table(pd.DataFrame({"step": np.arange(len(values)), "metric": metric, "value": values}), path)


def _pictures(folder):
    """Name in a run's folder -> bytes of a picture or film of that kind."""
    folder.mkdir(parents=True)
    across = np.linspace(0, 255, 1300).astype(np.uint8)
    found = {}
    for name, height in {"images.png": 500, "plots/motion.png": 600, "plots/stiffness.png": 400, "plots/topology.png": 500}.items():
        picture = np.repeat(np.repeat(across[None, :, None], height, axis=0), 3, axis=2)
        cv2.putText(picture, name, (40, height // 2), cv2.FONT_HERSHEY_SIMPLEX, 3, (60, 90, 200), 5)
        found[name] = cv2.imencode(".png", picture)[1].tobytes()
    for name in ("video.mp4", "turntable.mp4"):
        with Video(folder / name, RATE) as video:
            for frame in range(5):
                video.add(np.full((32, 48, 3), 40 * frame, np.uint8))
        found[name] = (folder / name).read_bytes()
        (folder / name).unlink()
    folder.rmdir()
    return found


def page_section(page, key):
    """The text of a section of a report, without tags; what cells and lines hold is separated by spaces."""
    match = re.search(rf'<section id="{key}">(.*?)</section>', page, re.DOTALL)
    assert match, key
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", match[1])).split())


def _relative(path, folder):
    return Path(os.path.relpath(path, folder)).as_posix()
