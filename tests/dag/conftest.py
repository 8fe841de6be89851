import pytest

from tests.support.project import copy_workflow


@pytest.fixture
def project(tmp_path):
    """A project folder of the test's own."""
    return copy_workflow(tmp_path / "project")
