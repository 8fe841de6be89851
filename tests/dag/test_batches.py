"""Searches and fits of two scenes in one job each (`gpus.batch`), on the CPU."""

import json
import shutil

import pytest

from tests.support.project import SCENE, run

OTHER = "toy_cloth_lift_smooth"
TARGETS = [f"results/{name}/baseline/0/fit.json" for name in (SCENE, OTHER)]
CHANGES = {"methods": ["baseline"], "scenarios": [SCENE, OTHER], "seeds": [0], "fit": {"epochs": 2}}


def files(project, name: str) -> list[bytes]:
    return [(project / path).with_name(name).read_bytes() for path in TARGETS]


@pytest.mark.slow
def test_two_scenes_in_one_job_end_as_each_alone_and_what_is_finished_stays(project):
    batch = CHANGES | {"gpus": {"batch": 2}}
    output = run(project, batch, "--", *TARGETS)
    assert {"searches", "fits"} <= {words[0] for words in map(str.split, output.splitlines()) if words}
    results = project / "results"
    searched, fitted = (json.loads((results / SCENE / f"{name}-0.json").read_text())["facts"] for name in ("searches", "fits"))
    assert {path.split("/")[1] for path in searched["searches"]} == {SCENE, OTHER}
    assert set(fitted["fits"]) == set(TARGETS)
    assert searched["errors"] == fitted["errors"] == {}
    twins = files(project, "twin.npz")
    # Each has its own record, log and job record, and the search was simulated in the batch.
    for name in (SCENE, OTHER):
        assert json.loads((results / name / "search-uniform" / "0" / "search.json").read_text())["attempts"] == 1
        assert (results / "logs" / "search" / name / "uniform" / "0.log").exists()

    def jobs_of(*more: str, **changes: object) -> set[str]:
        planned = run(project, batch | changes, "--dry-run", "--", *TARGETS, *more)
        return {words[0] for words in map(str.split, planned.splitlines()) if len(words) == 2 and words[1].isdigit()}

    assert not jobs_of() & {"search", "searches", "fit", "fits"}, "nothing is made again"
    # One that is lost is made again, by the job that does it together with others; the finished one stays.
    (project / TARGETS[1]).unlink()
    kept = (project / TARGETS[0]).stat().st_mtime_ns
    assert jobs_of() & {"search", "searches", "fit", "fits"} == {"fit", "fits"}
    run(project, batch, "--", *TARGETS)
    assert (project / TARGETS[0]).stat().st_mtime_ns == kept
    assert files(project, "twin.npz") == twins

    for name in (SCENE, OTHER):
        shutil.rmtree(results / name / "baseline")
        shutil.rmtree(results / name / "search-uniform")
    output = run(project, CHANGES | {"gpus": {"batch": 1}}, "--", *TARGETS)
    assert not {"searches", "fits"} & {words[0] for words in map(str.split, output.splitlines()) if words}
    assert files(project, "twin.npz") == twins
