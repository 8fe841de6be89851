"""A capture whose camera missed a frame, and its server with a stand-in for the masks' method."""

import pytest

from tests.extensions.annotate.painted import Painted
from tests.extensions.annotate.served import served
from tests.support.browser import Browser
from tests.support.moving import moving


@pytest.fixture
def capture(tmp_path):
    return moving(tmp_path / "capture", missing=(4,))


@pytest.fixture
def painted(monkeypatch):
    return Painted(monkeypatch)


@pytest.fixture
def client(capture, painted):
    with served(capture) as client:
        yield client


@pytest.fixture(scope="module")
def browser():
    with Browser(served=True) as browser:
        yield browser
