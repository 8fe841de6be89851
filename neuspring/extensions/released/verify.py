"""`neuspring verify-released`: compares PhysTwin's released results with this code and with the published scores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from neuspring.config import ScenarioRow
from neuspring.core.artifacts import Observations, Trajectory
from neuspring.core.errors import InputError
from neuspring.core.files import write_text
from neuspring.core.text import Progress
from neuspring.extensions.released.files import Released, epoch, read_checkpoint, read_parameters, read_prediction
from neuspring.intake import phystwin
from neuspring.intake.phystwin import released_cases
from neuspring.physics.topology import uniform_topology
from neuspring.scores import metrics
from neuspring.scores.metrics import METRICS
from neuspring.scores.paper import Values, released_scores

COLUMNS = ("scenario", "task", "quantity", "ours", "published", "tolerance", "outcome", "note")
MEAN = "MEAN22_REEVAL"
"""Name of the published means over the 22 cases, evaluated again with more digits than in the paper."""
Row = dict[str, Any]


def verify_released(root: Path, output: Path, scenarios: Sequence[str] = (), published: Values | None = None) -> pd.DataFrame:
    """Compare the released results in `root` (the folder of data, experiments, ...); write output/verify.csv.

    Returns one row per comparison (COLUMNS). The outcome is passed, failed, measured (no published number) or skipped (a missing
    file). `scenarios` defaults to all cases in `root`, `published` to the table of this package. Raises InputError without cases.
    """
    folder = root / "data" / "different_types"
    present = sorted(path.name for path in folder.glob("*/") if not path.name.startswith("."))
    if not present or (unknown := [name for name in scenarios if name not in present]):
        rule = f"must contain released cases: {', '.join(unknown) if present else 'at least one'}"
        raise InputError(folder, rule, ", ".join(present) or "none", "Run `neuspring fetch phystwin --data-root ...`.")
    values = released_scores() if published is None else published
    rows, names = list[Row](), list(scenarios) or present
    progress = Progress("verify", len(names))
    for done, name in enumerate(names, start=1):
        rows += _compare(Released(root, name), values)
        progress.update(done, name)
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    if set(names) >= set(released_cases()):
        table = pd.concat([table, pd.DataFrame(_means(table, values), columns=list(COLUMNS))], ignore_index=True)
    write_text(output / "verify.csv", table.to_csv(index=False))
    return table


def _compare(case: Released, published: Values) -> list[Row]:
    row = ScenarioRow(
        scenario=case.name, source="phystwin", category="released", path=str(case.folder), self_collision=False, ground=True
    )
    try:
        observations = phystwin.read(row, case.folder)
    except InputError as error:
        return [_row(case, "processed data", outcome="failed", note=str(error))]
    rows = list(_sizes(case, observations))
    for quantity, files, compare in (
        ("checkpoint", (case.parameters, case.checkpoint), _springs),
        ("scores", (case.prediction,), _scores),
    ):
        if absent := [str(file) for file in files if not file.exists()]:
            rows.append(_row(case, quantity, outcome="skipped", note=f"{', '.join(absent)}: no such file"))
            continue
        try:
            rows += compare(case, observations, published)
        except InputError as error:
            rows.append(_row(case, quantity, outcome="failed", note=str(error)))
    return rows


def _sizes(case: Released, observations: Observations) -> Iterator[Row]:
    """Compare sizes of the case with the table of released cases."""
    sizes = {"frames": observations.scenario.frame_count, "train_end": observations.scenario.train_end}
    sizes |= {"object_points": observations.object_points.shape[1], "nodes": len(observations.nodes)}
    known = released_cases().get(case.name, {})
    for quantity, size in sizes.items():
        yield _row(case, quantity, ours=size, published=_whole(known, quantity))


def _springs(case: Released, observations: Observations, _: Values) -> Iterator[Row]:
    """Compare springs built from the searched parameters with the checkpoint, and its epoch with the table."""
    parameters, (stiffness, object_springs) = read_parameters(case.parameters), read_checkpoint(case.checkpoint)
    rebuilt = uniform_topology(
        observations.nodes,
        observations.controller_points[0],
        parameters["object_radius"],
        int(parameters["object_max_neighbours"]),
        parameters["controller_radius"],
        int(parameters["controller_max_neighbours"]),
    )
    known = released_cases().get(case.name, {})
    yield _row(case, "springs of the checkpoint", ours=len(rebuilt.springs), published=len(stiffness))
    yield _row(case, "object springs of the checkpoint", ours=rebuilt.object_spring_count, published=object_springs)
    yield _row(case, "springs", ours=len(rebuilt.springs), published=_whole(known, "springs"))
    yield _row(case, "best epoch", ours=epoch(case.checkpoint), published=_whole(known, "best_epoch"))


def _scores(case: Released, observations: Observations, published: Values) -> Iterator[Row]:
    """Compare frame 0 of the released prediction with the nodes, and its metrics with the published scores."""
    positions = read_prediction(case.prediction, observations.scenario.frame_count, len(observations.nodes))
    moved = int((positions[0] != observations.nodes).any(axis=1).sum())
    note = "frame 0 must equal [object_points[0] | surface_points | interior_points] in float32"
    yield _row(case, "other nodes in frame 0", ours=moved, published=0, note=note)
    scores = metrics.score(Trajectory(positions=positions, frame_count=len(positions)), observations, "released", 0)
    for score in scores[scores["metric"].isin(["chamfer", "track_error"])].to_dict("records"):
        yield _score(case.name, score["task"], score["metric"], score["value"], published)


def _means(table: pd.DataFrame, published: Values) -> Iterator[Row]:
    scores = table[table["quantity"].isin(METRICS)]
    for (task, metric), values in scores.groupby(["task", "quantity"])["ours"]:
        yield _score(MEAN, str(task), str(metric), values.mean(), published)


def _score(scenario: str, task: str, metric: str, ours: float, published: Values) -> Row:
    known = published.get((scenario, task, metric))
    tolerance = max(METRICS[metric].tolerance, known.slack if known else 0.0)
    return _row(scenario, metric, task=task, ours=ours, published=known.value if known else None, tolerance=tolerance, note="m")


def _row(case: Released | str, quantity: str, **values: Any) -> Row:
    """One row; without a given outcome, the difference and the tolerance decide."""
    row: Row = {"scenario": case if isinstance(case, str) else case.name, "quantity": quantity, "tolerance": 0.0} | values
    if "outcome" not in row:
        known = row["published"] is not None
        close = known and bool(np.abs(row["ours"] - row["published"]) <= row["tolerance"])  # False for NaN.
        row["outcome"] = ("passed" if close else "failed") if known else "measured"
    return row


def _whole(known: Mapping[str, str], column: str) -> int | None:
    """A count in the table of released cases; None if it is unknown."""
    return int(known[column]) if known.get(column) else None
