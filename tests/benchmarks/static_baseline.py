"""For scale, the errors of holding frame 0: python -m tests.benchmarks.static_baseline RESULTS_FOLDER"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from neuspring import metrics
from neuspring.artifacts import Observations, Trajectory


def main(results: Path) -> None:
    """Print the equal-scenario mean of every task and metric, mm."""
    tables = []
    # Targets of transfers have observations and no runs: they are not part of the tables beside which this stands.
    for folder in sorted({path.parents[2] for path in results.glob("*/*/*/scores.parquet")}):
        seen = Observations.load(folder / "observations.npz")
        frames = seen.scenario.frame_count
        held = Trajectory(positions=np.repeat(seen.nodes[None], frames, axis=0), frame_count=frames)
        tables.append(metrics.score(held, seen, "static", 0))
    if not tables:
        raise SystemExit(f"{results}: no SCENARIO/METHOD/SEED/scores.parquet here; run the workflow first")
    means = metrics.averages(pd.concat(tables))
    for row in means.itertuples():
        print(f"{row.task:15} {row.metric:12} {1e3 * row.equal:8.2f} mm over {row.scenarios} scenarios")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
