"""The check of released results is there, also where the package was not installed anew since its entry point came."""

import pytest

from neuspring import checks
from neuspring.core.checks import Check
from neuspring.extensions.released.run import RELEASED
from neuspring.registry import Registry, modules


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    if "released" not in checks.CHECKS:
        own = {**modules(checks.__name__, "CHECKS"), "released": RELEASED}
        monkeypatch.setattr(checks, "CHECKS", Registry("checks", own, (Check, tuple)))
