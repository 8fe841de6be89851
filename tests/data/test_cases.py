"""The table of the released cases."""

from __future__ import annotations

from neuspring.data.phystwin import released_cases


def test_the_table_of_released_cases() -> None:
    cases = released_cases()
    assert len(cases) == 22
    assert sum(int(row["frames"]) for row in cases.values()) == 2423
    assert sum(int(row["frames"]) - int(row["train_end"]) for row in cases.values()) == 735
    assert all(int(row["train_end"]) == int(0.7 * int(row["frames"])) for row in cases.values())
    assert [name for name, row in cases.items() if not row["nodes"]] == [
        "double_lift_sloth",
        "double_stretch_sloth",
        "single_lift_sloth",
    ]
