"""Results for figures, made once; tests only read them."""

import pytest
from matplotlib import pyplot as plt

from tests.support.played import results
from tests.support.shown import METHODS, filmed


@pytest.fixture(scope="session")
def plain(tmp_path_factory):
    return results(tmp_path_factory.mktemp("plain"), METHODS)


@pytest.fixture(scope="session")
def video(tmp_path_factory):
    return filmed(tmp_path_factory.mktemp("video"))


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")
