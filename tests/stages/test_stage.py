"""The signature of a stage defines its command, its record, the propagation of failures and its position in the workflow."""

from __future__ import annotations

import pkgutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pytest

from neuspring import config, stages
from neuspring.config import Config
from neuspring.core.artifacts import Observations
from neuspring.core.errors import InputError, NumericalFailure
from neuspring.core.records import Before, Recorder, StageRecord, digest_file
from neuspring.stages import FLOW, LEARNED, STAGES
from neuspring.stages.stage import MayFail, Written, stage
from tests.support import small


@stage(output="{scenario}/{method}/{seed}/weigh.json", reads=("toy.frames",), minutes=1)
def weigh(
    observations: Observations,
    search: Before,
    settings: Config,
    run: Recorder,
    fit: MayFail | None = None,
    pool: Sequence[Observations] = (),
    scale: Annotated[float, "grams per point"] = 1.0,
    heavy: bool = False,
    device: str = "auto",
) -> Written:
    """Observations -> a weight: its unit is g."""
    if scale < 0:
        raise NumericalFailure("a scale is positive")
    files = run.beside(text="weight.txt")
    files["text"].write_text(str(scale * len(observations.nodes) * (2 if heavy else 1)))
    failed = fit.record.status == "failed" if fit else None
    return Written(files=files, facts={"pool": len(pool), "fit_failed": failed, "frames": settings.toy.frames, "device": device})


@pytest.fixture
def given(tmp_path):
    small.observations().save(tmp_path / "observations.npz")
    Recorder("search", tmp_path / "search.json").save()
    return {"observations": tmp_path / "observations.npz", "search": tmp_path / "search.json", "output": tmp_path / "weigh.json"}


def test_a_record_holds_digests_of_inputs_settings_that_are_read_and_options(given):
    weigh(**given, pool=[given["observations"]] * 2, scale=0.5, device="cpu", settings=Config(toy=config.Toy(frames=7)))
    record = StageRecord.load(given["output"])
    seen = digest_file(given["observations"])
    assert record.inputs == {"observations": seen, "search": digest_file(given["search"]), "pool0": seen, "pool1": seen}
    assert record.settings == {"toy": {"frames": 7}, "scale": 0.5, "heavy": False}
    assert record.facts == {"pool": 2, "fit_failed": None, "frames": 7, "device": "cpu"}
    assert record.file("text", given["output"]).read_text() == str(0.5 * len(small.observations().nodes))


def test_every_record_names_the_code_and_a_product_that_is_no_record_has_one_beside_it(tmp_path):
    row = config.ScenarioRow(
        scenario="a", source="toy", category="rope", path="rope/lift/smooth", self_collision=False, ground=True
    )
    settings = Config(toy=config.Toy(frames=4))
    STAGES["observe"](scenario=row, settings=settings, output=tmp_path / "observations.npz")
    record = StageRecord.load(STAGES["observe"].record_of(tmp_path / "observations.npz"))
    assert record.settings["scenario"] == config.plain(row) and record.settings["toy"]["frames"] == 4
    assert record.code == STAGES["observe"].code_of(settings, {"scenario": row}) and len(record.code) == 16
    assert STAGES["fit"].record_of(tmp_path / "fit.json") == tmp_path / "fit.json"


def test_failures_are_passed_on_unless_the_signature_takes_them(given, tmp_path):
    Recorder("fit", tmp_path / "fit.json").save(failure="diverged")
    weigh(**given, fit=tmp_path / "fit.json")
    assert StageRecord.load(given["output"]).facts["fit_failed"] is True
    weigh(**given, scale=-1.0)
    assert StageRecord.load(given["output"]).reason == "a scale is positive"
    Recorder("search", given["search"]).save(failure="every candidate diverged")
    weigh(**given)
    assert StageRecord.load(given["output"]).reason == "search: every candidate diverged"


def test_missing_unknown_and_absent_inputs_are_refused_before_the_function_runs(given):
    with pytest.raises(InputError, match=r"stage weigh: takes observations, search.*missing \['search'\], unknown \['serch'\]"):
        weigh(observations=given["observations"], serch=given["search"], output=given["output"])
    given["search"].unlink()
    with pytest.raises(InputError, match=r"search\.json: this file must be readable"):
        weigh(**given)
    assert not given["output"].exists()


def test_a_command_line_says_what_was_given():
    values = {"observations": "o.npz", "search": "s.json", "pool": ["a", "b"], "scale": 0.25, "heavy": True}
    words = [
        "--observations",
        "o.npz",
        "--search",
        "s.json",
        "--pool",
        "a",
        "b",
        "--scale",
        "0.25",
        "--heavy",
        "--output",
        "w.json",
        "--settings",
    ]
    read = weigh.parse([*words, '{"toy": {"frames": 9}}'])
    assert read["settings"].toy.frames == 9
    assert {name: read[name] for name in values} == {
        **values,
        "observations": Path("o.npz"),
        "search": Path("s.json"),
        "pool": [Path("a"), Path("b")],
    }
    assert read["fit"] is None and read["device"] == "auto"
    with pytest.raises(SystemExit):
        weigh.parse(["--observations", "o.npz"])


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_has_a_command_and_tells_its_inputs_from_earlier_stages(name):
    declared = STAGES[name]
    assert declared.name == name and declared.about and " -> " in declared.about
    earlier = {other.product for other in list(STAGES.values())[: list(STAGES).index(name)]}
    assert set(declared.inputs) - {declared.product} <= earlier | {"pool", "targets", LEARNED}
    with pytest.raises(SystemExit) as ended:
        declared.parse(["--help"])
    assert ended.value.code == 0


def test_a_stage_draws_the_numbers_of_a_new_process_whatever_ran_before_it(given):
    """Cameras of a capture are segmented one after the other in one process; grabCut draws from OpenCV's generator."""
    drawn = []

    @stage(output="{scenario}/drawn.json")
    def draw(run: Recorder) -> Written:
        drawn.append(cv2.randu(np.zeros(4), 0, 1).tolist())
        return Written()

    for _ in range(2):
        draw(output=given["output"])
    assert drawn[0] == drawn[1]
    code = "import cv2, numpy as np; print(cv2.randu(np.zeros(4), 0, 1).tolist())"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == f"{drawn[0]}\n"


def test_every_module_is_listed_in_the_flow():
    assert {found.name for found in pkgutil.iter_modules(stages.__path__)} == {*FLOW.split(), "stage"}
