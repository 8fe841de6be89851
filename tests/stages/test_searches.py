"""Searches of several scenes that share launches leave what each would leave alone; what goes wrong with one is its own."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd

from neuspring import config
from neuspring.core.artifacts import Twin
from neuspring.core.records import StageRecord
from neuspring.stages.observe import observe
from neuspring.stages.search import search
from neuspring.stages.searches import searches
from tests.support import small

SETTINGS = config.Config(search=config.Search(rollouts=11), toy=config.Toy(frames=6), device="cpu")
TEXT = json.dumps({name: config.plain(SETTINGS)[name] for name in ("search", "simulation", "losses", "released_quirks")})


def test_searches_of_two_scenes_end_as_each_alone_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    seen = {"rope": tmp_path / "rope.npz", "cloth": tmp_path / "cloth.npz", "damaged": tmp_path / "damaged.npz"}
    for name in ("rope", "cloth"):
        observe(scenario=small.row(f"{name}/lift/smooth"), settings=SETTINGS, output=seen[name])
    seen["damaged"].write_bytes(b"no archive")
    outputs = {name: tmp_path / name / "search.json" for name in seen}
    given = {"clusters": 1, "body": "lattice", "leave_out": False, "seed": 1}
    jobs = {str(outputs[name]): {"observations": str(path)} for name, path in seen.items()}
    rows = json.dumps([{"jobs": jobs, "options": given, "settings": TEXT}])

    searches(rows=rows, device="cpu", output=tmp_path / "searches.json")
    facts = StageRecord.load(tmp_path / "searches.json").facts
    assert facts["searches"] == [str(outputs[name]) for name in ("rope", "cloth")]
    assert list(facts["errors"]) == [str(outputs["damaged"])]
    assert not any(output.exists() for output in outputs.values()), "results are those of their own jobs"

    for name in ("rope", "cloth"):
        trace = outputs[name].with_name("trace.parquet")
        judged = pd.read_parquet(trace)
        before = trace.stat().st_mtime_ns
        for output in (outputs[name], tmp_path / "alone" / name / "search.json"):
            search(observations=seen[name], settings=SETTINGS, device="cpu", output=output, **given)
        records = [StageRecord.load(path / "search.json") for path in (tmp_path / name, tmp_path / "alone" / name)]
        assert trace.stat().st_mtime_ns == before, "nothing was simulated again"
        assert (records[0].settings, records[0].inputs, records[0].facts, records[0].attempts) == (
            (records[1].settings, records[1].inputs, records[1].facts, records[1].attempts)
        )
        alone = pd.read_parquet(tmp_path / "alone" / name / "trace.parquet")
        pd.testing.assert_frame_equal(judged.drop(columns="seconds"), alone.drop(columns="seconds"), check_exact=True)
        twins = [(tmp_path / part / name / "twin.npz") for part in ("", "alone")]
        assert Twin.load(twins[0]).counts == Twin.load(twins[1]).counts
        assert twins[0].read_bytes() == twins[1].read_bytes()

    # Finished searches are left alone.
    searches(rows=rows, device="cpu", output=tmp_path / "searches.json")
    assert StageRecord.load(tmp_path / "searches.json").facts["searches"] == []
