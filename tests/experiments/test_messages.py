"""Lines that tell how far a run is."""

import io
import re
from types import SimpleNamespace

from neuspring.core.job_records import Attempt, JobRecord, begin_run, this_run
from neuspring.experiments.messages import Overview, failed, tell_findings
from tests.support.runs import run_record


def save(results, name: str, **facts) -> None:
    record = JobRecord.of_log(results, results / "logs" / f"{name}.log")
    attempt = Attempt(started="2026-11-22T10:00:00.000+00:00", **({"outcome": "ok", "run": this_run(results)} | facts))
    JobRecord(**{**record.__dict__, "attempts": [attempt]}).save(results)


def test_a_line_tells_that_a_job_of_this_run_has_succeeded_and_how_many_have(tmp_path):
    begin_run(tmp_path)
    stream = io.StringIO()
    logs = [tmp_path / "logs" / f"{name}.log" for name in ("fit/rope/ours/0", "fit/rope/ours/1", "search/rope/uniform/0")]
    overview = Overview(tmp_path, logs, stream)
    save(tmp_path, "fit/rope/ours/0")
    save(tmp_path, "search/rope/uniform/0", run="an earlier run")
    save(tmp_path, "fit/rope/ours/1", outcome="transient")
    overview._look()
    assert re.fullmatch(r"\[1 of 3, \d\.\d s\] fit rope/ours/0\n", stream.getvalue())
    overview._look()
    save(tmp_path, "fit/rope/ours/1")
    overview.start()
    overview.stop()
    told, last = stream.getvalue().splitlines()[1:]
    assert told == "3 jobs to do; a line tells when one is done."
    assert re.fullmatch(r"\[2 of 3, \d\.\d s\] fit rope/ours/1", last)


def interrupted(results, **outcomes):
    """Jobs of this run that ended so, in a graph of runs that are not there."""
    begin_run(results)
    for name, outcome in outcomes.items():
        facts = {"outcome": outcome, "cause": "bad input", "message": "x: must be y."} if outcome == "permanent" else {}
        save(results, f"fit/{name}", **({"outcome": outcome} | facts))
    return SimpleNamespace(config=SimpleNamespace(results=str(results)), folder=f"{results}/tables", runs=lambda: ["nowhere"])


def test_a_run_that_was_stopped_says_what_is_kept_and_names_no_failure(tmp_path, capsys):
    failed(interrupted(tmp_path, a="killed", b="running", c="ok"))
    assert capsys.readouterr().out.splitlines() == [
        "",
        "Stopped, with 2 jobs at work: fit/a, fit/b.",
        "What is finished is kept. The same command continues; searches and fits go on from their checkpoints.",
    ]


def test_a_run_that_failed_ends_with_a_line_per_job_its_cause_and_what_to_do(tmp_path, capsys):
    failed(interrupted(tmp_path, a="killed", b="permanent"))
    output = capsys.readouterr().out.splitlines()
    assert output[1] == "The run did not finish. What is finished is kept."
    assert f"  fit/b: bad input (attempt 1): x: must be y.; {tmp_path}/logs/fit/b.log" in output
    assert output[-1] == "Mend the cause; the same command continues where this one stopped." and len(output) < 8


def test_the_end_of_a_run_tells_the_worst_fit_of_each_method_with_the_command_that_widens_its_bound(tmp_path, capsys):
    shares = {"a/model_b/0": 0.2, "b/model_b/0": 0.91, "b/baseline/0": 0.0}
    for name, share in shares.items():
        scenario, method, _ = name.split("/")
        (tmp_path / name).mkdir(parents=True)
        run_record(scenario=scenario, method=method, params={"fit.result.at_bound": share}).save(tmp_path / name / "run.json")
    paths = [f"{tmp_path}/{name}/run.json" for name in (*shares, "c/model_b/0")]
    tell_findings(SimpleNamespace(config=SimpleNamespace(results=str(tmp_path), scenarios=["a", "b"]), runs=lambda: paths))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "Perception and fits noticed 1 thing that may make results worse:"
    assert lines[1].startswith("  b: warning: model_b/0: springs at their bound: 91% of the springs lie at the bound")
    assert lines[1].endswith("add `--config 'methods=[model_b,model_b_wide]'` to the command.") and lines[2:] == [""]
