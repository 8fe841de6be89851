"""Search and fit on several recordings, through their stages: content of records, and no wrong sharing between fits."""

import numpy as np
import pandas as pd
import pytest

from neuspring import config
from neuspring.core.artifacts import Twin
from neuspring.core.records import StageRecord, digest_file
from neuspring.stages.fit import fit
from neuspring.stages.search import search
from tests.support import small

SETTINGS = config.Config(
    search=small.released(rollouts=6, start={"object_radius": 0.045, "stiffness": 1e4}),
    fit=config.Fit(epochs=2, learning_rate=5e-2),
)


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """Observations of one rope, moved in two ways."""
    folder = tmp_path_factory.mktemp("pool")
    paths = {name: folder / f"{name}.npz" for name in ("lift", "shake")}
    for name, path in paths.items():
        small.scene(f"rope/{name}/smooth").observations.save(path)
    return paths


def run(seen, folder, **pool):
    """Search and fit of the lifted rope."""
    found, fitted = folder / "search.json", folder / "fit" / "fit.json"
    search(observations=seen["lift"], settings=SETTINGS, clusters=1, seed=0, device="cpu", output=found, **pool)
    fit(observations=seen["lift"], search=found, settings=SETTINGS, kind="springs", device="cpu", output=fitted, **pool)
    return StageRecord.load(found), StageRecord.load(fitted)


def test_records_name_the_pool_and_count_its_frames(seen, tmp_path):
    alone = run(seen, tmp_path / "alone")
    pooled = run(seen, tmp_path / "pooled", pool=[seen["shake"]])
    for one, both in zip(alone, pooled, strict=True):
        assert "pool0" not in one.inputs
        assert both.inputs["pool0"] == digest_file(seen["shake"])
        assert one.status == both.status == "ok"
    ratio = [both.facts["spring_updates"] / (both.facts["springs"] * both.facts["substeps"]) for both in (alone[1], pooled[1])]
    assert ratio[1] == 2 * ratio[0]
    stiffness = [
        Twin.load(record.file("twin", tmp_path / name / "fit" / "fit.json")).material.stiffness
        for name, (_, record) in (("alone", alone), ("pooled", pooled))
    ]
    assert not np.array_equal(stiffness[0], stiffness[1])


def test_a_search_on_another_pool_starts_afresh(seen, tmp_path, capsys):
    given = {"observations": seen["lift"], "settings": SETTINGS, "clusters": 1, "seed": 0, "device": "cpu"}
    given["output"] = tmp_path / "search.json"
    search(**given)
    search(**given, pool=[seen["shake"]])
    assert "made with other inputs or settings" in capsys.readouterr().out
    first = pd.read_parquet(tmp_path / "trace.parquet")
    search(**given, pool=[seen["shake"]])
    assert "resuming the search after 6 rollouts" in capsys.readouterr().out
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "trace.parquet"), first)
