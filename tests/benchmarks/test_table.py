"""Text and file of the benchmark table, its comparison with a committed one, and the clock."""

import json
import time
from dataclasses import replace
from itertools import count

import pytest

from tests.benchmarks import bench, table
from tests.benchmarks.simulators import take_turns
from tests.benchmarks.table import Row

ROW = Row(section="frame", name="a: forward", device="cpu", median=4.0, least=3.0, nodes=400, springs=5000, substeps=80)
SLOWER = replace(ROW, name="a: forward, peer", median=6.0, ratio=1.5, reference=ROW.name)
START = Row(section="start", name="a job alone", device="cpu", median=2.5, least=2.25, unit="s")


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_text_has_a_line_per_row_with_its_cost_and_its_change():
    before = table.as_record({}, [replace(ROW, median=5.0), replace(START, unit="ms")], [])
    header, _, *lines = table.text([ROW, SLOWER, START], before).splitlines()
    shown = [dict(zip(cells(header), cells(line), strict=True)) for line in lines]
    # 4 ms / (5000 springs x 80 substeps) = 10 ns.
    assert shown[0] | {"median": "4 ms", "ns": "10.00", "batch": "1", "change": "-20 %", "ratio": ""} == shown[0]
    assert shown[1] | {"ratio": "1.50", "to": "a: forward", "change": ""} == shown[1]
    # Another unit is no change.
    assert shown[2] | {"median": "2.5 s", "ns": "", "nodes": "", "batch": "", "change": ""} == shown[2]


@pytest.mark.parametrize(("committed", "folder"), [(True, table.COMMITTED), (False, table.SCRATCH)])
def test_only_save_writes_into_the_committed_folder(tmp_path, monkeypatch, committed, folder):
    monkeypatch.setattr(table, "ROOT", tmp_path)
    record = table.as_record({"cpu": "x"}, [ROW, SLOWER], ["a note"])
    path = table.save(record, "here", committed=committed)
    assert path == tmp_path / folder / "here.json"
    assert json.loads(path.read_text()) == record
    assert table.last_kept("here") == (record if committed else None)
    assert record["rows"][0]["nanoseconds"] == pytest.approx(10)
    assert table.change(replace(ROW, median=5.0), table.medians(record)) == pytest.approx(0.25)
    assert table.change(START, table.medians(record)) is None


@pytest.mark.parametrize("rest", ["--quick", "--only=nodes", "--device=cpu"])
def test_a_part_of_the_table_is_not_saved(rest, capsys):
    with pytest.raises(SystemExit):
        bench.parsed(["--save", rest])
    assert "--save keeps a whole table" in capsys.readouterr().err


def test_the_kind_of_machine_is_a_file_name_of_processor_cores_and_gpu():
    facts = {"cpu": "Intel(R) Xeon(R) Gold 6530", "cpu_model": "207", "cores": 16, "gpu": "NVIDIA H200", "warp": "1.19.0"}
    assert table.kind(facts) == "intel-xeon-gold-6530-207-16-cores-nvidia-h200"
    assert table.kind(facts | {"gpu": "", "warp": "2"}) == "intel-xeon-gold-6530-207-16-cores"
    here = table.facts()
    assert here["cpu"] and here["cores"] >= 1 and table.kind(here) == table.kind(here).strip("-")
    text = "model\t\t: 167\nmodel name\t: Some CPU @ 2 GHz\nflags\t\t: a b\n\nmodel name\t: Other\n"
    assert [table.entry(text, name) for name in ("model", "model name", "stepping")] == ["167", "Some CPU @ 2 GHz", ""]


def test_simulators_take_turns_and_none_is_always_first():
    order = []
    times = take_turns({name: lambda name=name: order.append(name) for name in "abc"}, rounds=5)
    assert ["".join(order[3 * k : 3 * k + 3]) for k in range(6)] == ["abc", "bca", "cab", "abc", "bca", "cab"]
    # The first round is not timed.
    assert {name: len(its.seconds) for name, its in times.items()} == dict.fromkeys("abc", 5)


def test_rounds_end_when_their_time_is_up_but_not_before_the_least_number():
    calls = count()
    times = take_turns({"slow": lambda: (next(calls), time.sleep(0.02))}, rounds=50, least=4, seconds=0.0)
    assert len(times["slow"].seconds) == 4 and next(calls) == 5
    assert times["slow"].least >= 0.02
