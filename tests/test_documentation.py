"""The documentation says what the code does."""

from pathlib import Path

from tests import config_readme

ROOT = Path(__file__).parents[1]


def test_the_configuration_page_is_up_to_date_and_complete():
    page = (ROOT / "config" / "README.md").read_text()
    assert page == config_readme.text(), "run: python -m tests.config_readme"
    assert "|  |\n" not in page  # every key has a meaning
