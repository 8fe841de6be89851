"""Which settings fit the held-back tail of the training frames best, over development recordings.

python workflow/scripts/choices.py RESULTS_FOLDER [FITS.CSV]

RESULTS_FOLDER was made with config/choices/ (`--until fit` is enough). Every row there trains on the first four fifths of the
training frames and keeps the epoch that is best on the last fifth; frames behind the split are read by nothing. The table has, per
row, the geometric mean over recordings and seeds of that best tail loss, as a ratio to the row REFERENCE (default: field), with a
95 % t-interval of the logarithm over recordings, and the ratio of the lowest training loss.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from neuspring.core.records import StageRecord
from neuspring.experiments.benchmark import read_methods

REFERENCE = "field"
METHODS = Path(__file__).resolve().parents[2] / "config/choices/methods.yaml"


def losses(results: Path) -> pd.DataFrame:
    """One row per fit: recording, method, seed, best tail loss and lowest training loss, m^2; failed fits are left out."""
    rows, candidates = [], read_methods(METHODS)
    for path in sorted(results.glob("*/*/*/fit.json")):
        recording, method, seed = path.parts[-4:-1]
        if method not in candidates:
            continue
        record = StageRecord.load(path)
        if record.status != "ok":
            print(f"{path}: {record.reason}")
            continue
        history = pd.read_parquet(path.with_name("history.parquet"))
        lowest = float(history.loc[history["metric"] == "loss", "value"].min())
        rows.append((recording, method, seed, float(record.facts["best_loss"]), lowest))
    return pd.DataFrame(rows, columns=["recording", "method", "seed", "tail", "training"])


def table(found: pd.DataFrame, reference: str) -> pd.DataFrame:
    """Ratios of every method to `reference`, on the recordings and seeds that both have."""
    names, places = ["tail", "training"], ["recording", "seed"]
    base = found[found["method"] == reference].set_index(places)[names]
    rows = []
    for method, own in found.groupby("method", sort=False):
        ratios = np.log(own.set_index(places)[names] / base).dropna().groupby("recording").mean()
        tail, count = ratios["tail"], len(ratios)
        if not count:
            continue
        half = stats.t.ppf(0.975, count - 1) * tail.std(ddof=1) / np.sqrt(count) if count > 1 else np.nan
        rows.append(
            {
                "method": method,
                "recordings": count,
                "tail": np.exp(tail.mean()),
                "low": np.exp(tail.mean() - half),
                "high": np.exp(tail.mean() + half),
                "better": int((tail < 0).sum()),
                "training": np.exp(ratios["training"].mean()),
            }
        )
    columns = ["method", "recordings", "tail", "low", "high", "better", "training"]
    return pd.DataFrame(rows, columns=columns).sort_values("tail", ignore_index=True)


def main(results: Path, fits: Path | None = None) -> None:
    """Print the table; write the losses of every fit."""
    found = losses(results)
    if fits:
        found.to_csv(fits, index=False, float_format="%.4e")
    print(table(found, REFERENCE).to_string(index=False, float_format=lambda value: f"{value:.2f}"))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
