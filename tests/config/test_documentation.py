"""The documentation says what the code does."""

import typing
from pathlib import Path

import pytest
import yaml

from neuspring import config
from neuspring.config import page as config_page

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(not (ROOT / "neuspring" / "extensions").exists(), reason="the page has the settings of extensions")
def test_the_configuration_page_is_up_to_date_and_complete():
    page = (ROOT / "config" / "README.md").read_text()
    assert page == config_page.text(), "run: python -m neuspring.config.page"
    assert "|  |\n" not in page  # every key has a meaning
    head, _, _ = page.partition(config_page.HEADING)
    introduction, _, _ = head.partition("## Glossary")
    assert len(introduction.split()) <= 600


def test_meanings_begin_with_their_subject():
    for kind in [*config_page.sections().values(), *config_page.ROWS.values()]:
        for key, _, _, meaning in config_page.fields(kind):
            begins = {"What", "Whether", "Of", "How", "Where", "Which", "That", "If"}
            assert meaning.split()[0] not in begins, f"{kind.__name__}, {key}"


def sections(kind: type) -> set[type]:
    """A dataclass of the configuration and every one nested in it."""
    hints = list(typing.get_type_hints(kind).values())
    for hint in hints:
        # Sections that may be null, or that a mapping holds.
        hints += [inner for inner in typing.get_args(hint) if not isinstance(inner, str)]
    return {kind}.union(*(sections(hint) for hint in hints if config_page.is_section(hint)))


def test_every_section_is_on_the_page():
    assert set(config_page.sections().values()) == sections(config.Config)
    page = config_page.text()
    for title in config_page.sections():
        assert f"### {title}\n" in page


def test_shown_defaults_are_accepted_as_they_are_written():
    """Read as YAML by the strict configuration, they are the defaults."""
    written = {}
    for title, kind in config_page.sections().items():
        if title.startswith(("tune", "aims")):
            continue  # null and empty unless they are set
        place = written
        for name in [] if title == "(top level)" else title.split("."):
            place = place.setdefault(name, {})
        place |= {key.strip("`"): yaml.safe_load(default.strip("`")) for key, default, _, _ in config_page.fields(kind)}
    assert config.plain(config.parse(config.Config, written, "the page")) == config.plain(config.Config())


def test_ranges_are_those_that_the_configuration_enforces():
    shown = {key.strip("`"): words for key, _, words, _ in config_page.fields(config.Fit)}
    assert shown["epochs"] == "integer >= 1"
    assert shown["factor_learning_rate"] == "number > 0 or `null`"
    assert shown["damping"] == "`fixed`, `homogeneous`"
    assert "field" not in shown
