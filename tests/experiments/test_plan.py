"""What is told before the first job: missing data, hours, devices, tables, and what later configuration files change."""

from pathlib import Path

import pytest

from neuspring.core.errors import InputError
from neuspring.core.job_records import Attempt, JobRecord
from neuspring.experiments import needs, plan
from neuspring.experiments.graph import Graph
from tests.support.project import ROOT, config_with

RELEASED = ["single_lift_rope", "single_push_rope", "single_lift_sloth"]


def planned(results: Path, counts: dict[str, int], place: plan.Place, on_gpu: bool = False, **changes: object) -> list[str]:
    benchmark = needs.checked(config_with({"results": str(results)} | changes), ROOT, plan_only=True)
    benchmark.on_gpu = on_gpu
    wanted = needs.Needs(benchmark, "gpu" if on_gpu else "cpu")
    return plan.told(Graph(benchmark), wanted, counts, place, []).splitlines()


def released(folder: Path) -> dict[str, object]:
    return {"scenarios": RELEASED, "data_root": str(folder), "results": str(folder / "results")}


def test_all_scenarios_without_data_are_one_error_before_any_job_and_a_line_of_a_plan(tmp_path):
    case = tmp_path / "data" / "different_types"
    for name in RELEASED[:2]:
        (case / name).mkdir(parents=True)
    message = (
        rf"^{case}: 3 of 3 scenarios lack final_data\.pkl .single_lift_rope, .*`neuspring fetch phystwin --data-root {tmp_path} "
    )
    with pytest.raises(InputError, match=message):
        needs.checked(config_with(released(tmp_path)), ROOT)
    place = plan.Place(gpus=(), cores=2)
    line = planned(tmp_path / "results", {"fit": 3}, place, scenarios=RELEASED, data_root=str(tmp_path))[1]
    assert line.split()[:6] == ["data", f"{case}:", "3", "of", "3", "scenarios"]
    assert line.endswith("A run ends here, before its first job.")
    for name in RELEASED:
        (case / name).mkdir(exist_ok=True)
        for file in ("final_data.pkl", "split.json"):
            (case / name / file).touch()
    assert needs.checked(config_with(released(tmp_path)), ROOT).absent is None
    (case / RELEASED[1] / "split.json").unlink()
    with pytest.raises(InputError, match=rf"scenario single_push_rope: its data must exist; received {case}/.*split\.json\. Bring"):
        needs.checked(config_with(released(tmp_path)), ROOT)


def test_a_plan_without_data_root_says_how_to_give_it(tmp_path):
    told = "\n".join(planned(tmp_path, {"fit": 3}, plan.Place(gpus=(), cores=2), scenarios=RELEASED))
    assert "phystwin scenarios need data_root; received null. Give it: --config data_root=/path/to/data. Bring them: " in told


def test_hours_are_published_ones_scaled_by_the_settings_until_jobs_of_the_folder_say_better(tmp_path):
    sizes = {"search": {"rollouts": 110}, "fit": {"epochs": 100}}
    counts = {"search": 20, "fits": 2, "fit": 60, "train": 3, "all": 1}
    place = plan.Place(gpus=("0", "1"), cores=4)
    lines = planned(tmp_path, counts, place, on_gpu=True, **sizes)
    # 20 x 6 min and 60 x 2.5 min.
    assert lines[1].startswith(
        "  time     at least 4.5 h of GPU time, 2.2 h on 2 GPUs: fit 60 x 2.5 min, search 20 x 6.0 min (by PhysTwin's"
    )
    assert lines[2] == "           without a figure, and not counted: train (3)"
    for name, seconds in {"a": 60.0, "b": 120.0, "c": 600.0}.items():
        done = Attempt(started="2026-01-01T00:00:00+00:00", seconds=seconds, outcome="ok", devices=["0"])
        JobRecord(rule="fit", name=f"fit/{name}", log="", attempts=[done]).save(tmp_path)
    lines = planned(tmp_path, {"fit": 60}, place, on_gpu=True, **sizes)
    assert lines[1] == "  time     2.0 h of GPU time, 60.0 min on 2 GPUs: fit 60 x 2.0 min (by jobs of this results folder)"
    # A job on a GPU says nothing of one on the CPU.
    lines = planned(tmp_path, {"fit": 60}, place, **sizes)
    assert lines[1].startswith("  time     2.3 h of CPU time, 34.8 min on 4 cores: fit 60 x 2.3 min (by jobs of make demo")


def test_a_plan_says_how_jobs_share_gpus_and_where_tables_will_be(tmp_path):
    changes = {"gpus": {"jobs_per_gpu": 2}, "studies": ["table2"]}
    lines = planned(tmp_path, {"fit": 1}, plan.Place(gpus=("0", "3"), cores=8), on_gpu=True, **changes)
    assert "  devices  2 GPUs (0, 3), 2 jobs on each at once (gpus.jobs_per_gpu); " in lines[-2]
    assert "twins_per_launch: auto" in lines[-2] and lines[-2].endswith("8 cores, one a job")
    assert lines[-1] == f"  tables   {tmp_path}/tables/summary.md, report.html, studies/ (table2)"
    [devices] = [line for line in planned(tmp_path, {"fit": 1}, plan.Place(gpus=(), cores=1, cluster=True)) if "devices" in line]
    assert devices.endswith("the cluster's scheduler gives each job its own")
    assert planned(tmp_path, {"all": 1}, plan.Place(gpus=(), cores=1)) == [], "nothing is to be done"


def test_a_later_file_says_which_keys_it_changes_and_from_what(tmp_path):
    first, second, third = (tmp_path / name for name in ("data.yaml", "study.yaml", "more.yaml"))
    first.write_text("results: results/a\nmethods: [static]\nfit: {epochs: 20}\n")
    second.write_text("methods: [static, baseline]\nfit: {epochs: 20, horizon: 5}\n")
    third.write_text("fit: {epochs: 20}\n")
    assert plan.changes([first]) == []
    assert plan.changes([first, second, third]) == [
        'study.yaml, behind data.yaml, changes methods ["static"] -> ["static", "baseline"]; fit.horizon 1 -> 5',
        "more.yaml, behind data.yaml, study.yaml, changes nothing",
    ]
    shipped = ROOT / "config"
    assert plan.changes([shipped / "data/phystwin.yaml", shipped / "studies/paper.yaml"])[0].endswith("changes nothing")


def test_published_times_are_of_rules_that_there_are():
    assert {rule for rule, _ in needs.PUBLISHED} | set(needs.UNITS_OF_WORK) <= set(needs.FIRST_REQUEST)
