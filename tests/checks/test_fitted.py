"""Findings of fits whose springs lie at a limit of their stiffness."""

import math

import pytest

from neuspring.checks import examine
from neuspring.checks.fitted import WIDER_ROWS
from neuspring.config import Config, plain
from neuspring.experiments.benchmark import read_methods, with_method
from tests.support.project import ROOT
from tests.support.runs import run_record

SETTINGS = {"fit.fit.output_bound": 1.5, "fit.fit.stiffness_range": [0.0, 1e5]}


def found(method, **shares):
    figures = {f"fit.result.{name}": share for name, share in shares.items()}
    return examine("fit", f"{method}/0", run_record(method=method, params=SETTINGS | figures))


def test_a_fit_whose_springs_lie_at_their_bound_is_a_finding_with_the_command_that_widens_it():
    [one] = found("model_b", at_bound=0.91, at_stiffness_range=0.02)
    assert (one.level, one.value, one.limit) == ("warning", 0.91, (0.0, 0.05))
    assert str(one) == (
        "warning: model_b/0: springs at their bound: 91% of the springs lie at the bound of their stiffness, 4.5 times the "
        "searched one or less by as much (fit.output_bound). "
        "Compare with a wider bound: add `--config 'extra_rows={ours: config/rows/ours.yaml}' 'methods=[model_b,model_b_wide]'` "
        "to the command."
    )
    [other] = found("model_b_wide", at_bound=0.2)
    assert other.remedy == "Raise output_bound in the settings of the row model_b_wide of the method table."


def test_springs_at_the_end_of_the_range_say_which_range_holds_more():
    [one] = found("baseline", at_stiffness_range=0.3)
    assert "30% of the springs lie at an end of the range of stiffness, 0 to 100000 N (fit.stiffness_range). " in one.text
    assert one.remedy == "Widen it: add `--config 'fit={stiffness_range: [0.0, 1000000.0]}'` to the command."


def test_free_springs_and_runs_without_a_fit_have_no_finding():
    assert found("model_b", at_bound=0.05, at_stiffness_range=0.0) == found("search_only") == []


@pytest.mark.parametrize(("row", "wider"), WIDER_ROWS.items())
def test_a_wider_row_differs_by_its_bound_alone(row, wider):
    methods = read_methods(ROOT / "config" / "methods.yaml", [ROOT / "config" / "rows" / "ours.yaml"])
    narrow, wide = (plain(with_method(Config(), methods[name], name).fit) for name in (row, wider))
    assert {key for key in wide if wide[key] != narrow[key]} == {"output_bound"}
    assert math.exp(wide["output_bound"]) > 20 > math.exp(narrow["output_bound"])
    same = ("search", "fit", "pool", "oracle")
    assert [getattr(methods[row], key) for key in same] == [getattr(methods[wider], key) for key in same]
