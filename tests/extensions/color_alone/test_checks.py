"""Checks state which properties of an object one image does not determine."""

from types import SimpleNamespace

import pytest

from neuspring.checks import examine


@pytest.mark.parametrize(
    ("backend", "raised", "levels"), [("body", 0.4, ["warning"]), ("body", 0.0, ["note"]), ("body, standing", 0.4, [])]
)
def test_how_a_body_lies_or_stands_is_said(backend, raised, levels):
    facts = {"shape_longest": 0.55, "shape_across": 0.3, "shape_raised": raised}
    found = examine("pose", "shape", SimpleNamespace(backend=f"color alone, {backend}", facts=facts))
    assert [one.level for one in found] == levels
