"""The configuration page states what the code enforces."""

from pathlib import Path

import pytest
import yaml

from neuspring import config
from tests.config import page as config_page

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(not (ROOT / "neuspring" / "extensions").exists(), reason="the page has the settings of extensions")
def test_the_configuration_page_is_up_to_date_and_complete():
    page = (ROOT / "config" / "README.md").read_text()
    assert page == config_page.text(), "run: python -m tests.config.page"
    assert "| . |\n" not in page  # every key has a meaning
    assert len(page.partition(config_page.HEADING)[0].split()) <= 500


def test_shown_defaults_are_accepted_as_they_are_written():
    """Read as YAML by the strict configuration, they are the defaults."""
    written = {}
    for title, schema in config_page.sections().items():
        if title.startswith(("tune", "aims", "rows")):
            continue  # null and empty unless they are set
        place = written
        for name in [] if title == "(top level)" else title.split("."):
            place = place.setdefault(name, {})
        rows = config_page.fields(schema)[1:]
        place |= {key.strip("`"): yaml.safe_load(default.strip("`")) for key, default, _, _ in rows}
    assert config.plain(config.parse(config.Config, written, "the page")) == config.plain(config.Config())


def test_ranges_are_those_that_the_configuration_enforces():
    shown = {key.strip("`"): words for key, _, words, _ in config_page.fields(config_page.sections()["fit"])}
    assert shown["epochs"] == "integer >= 1"
    assert shown["factor_learning_rate"] == "number > 0 or `null`"
    assert shown["damping"] == "`fixed`, `homogeneous`"
    assert "field" not in shown
