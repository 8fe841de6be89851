"""A results folder, and a server of the playground."""

import pytest

from tests.support.played import results


@pytest.fixture
def scenario(tmp_path):
    return results(tmp_path)


@pytest.fixture(scope="module")
def server():
    pytest.importorskip("viser", reason="the extra [play] is not installed")
    from neuspring.extensions.play.serve import start

    one = start("127.0.0.1", 0)
    yield one
    one.stop()
