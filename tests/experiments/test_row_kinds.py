"""Oracles: what the workflow makes of them."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from neuspring import config
from neuspring.config import Method, parse
from neuspring.core.errors import InputError
from neuspring.experiments.benchmark import Benchmark
from neuspring.experiments.graph import Graph
from neuspring.experiments.tuning.space import Plan
from neuspring.stages import STAGES

ROOT = Path(__file__).parents[2]
NAMES = ["baseline", "neuspring", "oracle_neuspring"]
SCENES = ["toy_rope_lift_smooth", "toy_rope_shake_smooth"]


def benchmark(**changes: Any) -> Benchmark:
    values = config.read_yaml(ROOT / "config" / "data" / "toy.yaml") | {"methods": NAMES, "scenarios": SCENES, "studies": []}
    return Benchmark(values | changes, ROOT)


def job(name: str) -> SimpleNamespace:
    return SimpleNamespace(scenario=SCENES[0], method=name, seed=0)


def test_records_name_oracles_and_leave_other_rows_as_they_were():
    graph = Graph(benchmark())
    variants = {name: graph.variant(job(name)) for name in NAMES}
    assert {name for name, variant in variants.items() if "oracle" in variant} == {"oracle_neuspring"}
    assert variants["oracle_neuspring"]["oracle"] is True
    assert variants["baseline"] == {
        "search": "uniform",
        "clusters": 1,
        "fit": "springs",
        **benchmark().methods["baseline"].settings,
    }


def test_an_oracles_fit_is_its_own_though_its_settings_are_those_of_another():
    made = benchmark(seeds=[0, 1, 2])
    assert made.fit_of_method["oracle_neuspring"] == "oracle_neuspring"
    graph = Graph(made)
    assert graph.settings(STAGES["fit"], job("oracle_neuspring")) == graph.settings(STAGES["fit"], job("neuspring"))
    assert graph.inputs(STAGES["fit"])(job("oracle_neuspring")) == graph.inputs(STAGES["fit"])(job("neuspring"))
    together = json.loads(graph.options(STAGES["fits"], SimpleNamespace(scenario=SCENES[0]))["rows"])
    assert [bool(row.get("oracle")) for row in together] == [False, False, True]


def test_oracles_are_not_transferred():
    made = benchmark(transfers={SCENES[0]: [SCENES[1]]})
    assert {path.split("/")[-3] for path in Graph(made).transfers()} == {"baseline", "neuspring"}


def test_no_sweep_chooses_by_an_oracle():
    values = {"study": "s", "method": "oracle_neuspring", "space": {"fit.learning_rate": {"low": 1e-4, "high": 1e-2}}, "seed": 0}
    tune = parse(config.Config, {"tune": values}, "x").tune
    assert tune is not None
    with pytest.raises(InputError, match="an oracle sees the future"):
        Plan.of(config.Config(), tune, ROOT)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"search": "uniform", "oracle": True}, "an oracle has a fit"),
        ({"model": "static", "oracle": True}, "an oracle has a fit"),
        ({"search": "uniform", "carry_over": "state"}, "removed"),
    ],
)
def test_rows_that_cannot_be(row, message):
    with pytest.raises(InputError, match=message):
        parse(Method, {"description": "x"} | row, "x")


def test_an_oracle_with_a_tail_is_refused_before_any_job(tmp_path):
    row = "bad: {search: uniform, fit: field, oracle: true, description: x, settings: {selection: tail}}"
    (tmp_path / "bad.yaml").write_text(row)
    with pytest.raises(InputError, match="an oracle is fitted on all frames and holds none back"):
        benchmark(method_table=str(tmp_path / "bad.yaml"), methods=["bad"], compare_with=None)
