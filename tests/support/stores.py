"""Shared by tests of tracking: small run records, and the index of the results folder."""

import hashlib
import json
import socket

import pandas

from neuspring.config import Tracking
from neuspring.experiments.tracking.store import default_uri
from tests.support.runs import run_record

ENDED = "2026-11-21T10:05:30+00:00"
STEPS = 1100
"""Points of the longest history: more than one call of `log_batch` takes."""


def write_run(results, scenario="rope", seed=0, **changes):
    """A small run: 3 scores, 1 timing, 2 histories (one in another folder), 2 artifact folders."""
    folder, search = results / scenario / "ours" / str(seed), results / scenario / "search-uniform"
    for path in (folder, search):
        path.mkdir(parents=True, exist_ok=True)
    rows = [("future", "track_error", 0.0123456, "m"), ("future", "chamfer", 0.005, "m"), ("train", "chamfer", float("nan"), "m")]
    scores = pandas.DataFrame(rows, columns=["task", "metric", "value", "unit"])
    scores.assign(scenario=scenario, category="toy", method="ours", seed=seed, frames=18).to_parquet(folder / "scores.parquet")
    pandas.DataFrame({"step": range(STEPS), "metric": "loss", "value": 1.0}).to_parquet(folder / "fit.parquet")
    steps = {"step": [0, 1, 1], "metric": ["best", "best", "sigma"], "value": [3.0, 2.0, 0.5]}
    pandas.DataFrame(steps).to_parquet(search / "history.parquet")
    (folder / "twin.npz").write_bytes(b"twin")
    (search / "coarse.npz").write_bytes(b"coarse")
    path = folder / "run.json"
    run_record(
        run_key=hashlib.sha256(f"{scenario} {seed}".encode()).hexdigest(),
        scenario=scenario,
        category="toy",
        variant={"search": "uniform", "fit": "springs", "clusters": 4, "frozen": False},
        seed=seed,
        commit="abc123",
        data_digest="d1",
        ended=ENDED,
        timings={"fit": 12.5},
        histories={"fit": "fit.parquet", "search": "../../search-uniform/history.parquet"},
        artifacts={"twin": ["twin.npz"], "search": ["../../search-uniform/coarse.npz"]},
    ).save(path)
    params = {f"fit.p{i}": i for i in range(120)} | {"fit.betas": [0.9, 0.99], "long": "x" * 900}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"params": params} | changes))
    return path


def client_of(results):
    """A client of the results folder's own index."""
    from mlflow import MlflowClient

    return MlflowClient(tracking_uri=default_uri(results))


def runs_of(results):
    """All runs in the results folder's own index."""
    client = client_of(results)
    return list(client.search_runs([client.get_experiment_by_name(Tracking().experiment).experiment_id]))


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        return port
