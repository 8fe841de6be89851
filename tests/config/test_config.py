"""The configuration is strict: errors name the path of the key, nothing is cast, nothing is ignored."""

import dataclasses
import functools
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from snakemake.cli import parse_config

from neuspring import config
from neuspring.config import Config, parse, plain
from neuspring.config.effort import EFFORT_SIZES, EFFORTS, sizes
from neuspring.core import artifacts
from neuspring.core.errors import InputError
from neuspring.core.text import listed
from neuspring.twin import field
from tests.support.extensions import with_extensions

ROOT = Path(__file__).parents[2]

MINIMAL = "scenarios: [rope]\nmethods: [ours]\n"


def load(text):
    return parse(Config, yaml.safe_load(MINIMAL + text), "config.yaml")


def refused(text):
    with pytest.raises(InputError) as caught:
        load(text)
    message = str(caught.value)
    assert message.startswith("config.yaml: ")
    return message


# Defaults -------------------------------------------------------------------------------------------------------------


def test_defaults_are_valid():
    made = load("")
    assert (made.scenarios, made.methods, made.seeds) == (("rope",), ("ours",), (0,))
    assert made.simulation.substeps == "auto"
    assert not any(dataclasses.asdict(made.released_quirks).values())


@pytest.mark.parametrize(("text", "seeds"), [("'0,1,2'", (0, 1, 2)), ("'4'", (4,)), ("7", (7,)), ("['2', '0']", (2, 0))])
def test_seeds_may_be_text_as_the_command_line_hands_them_over(text, seeds):
    assert load(f"seeds: {text}\n").seeds == seeds


# Mistakes -------------------------------------------------------------------------------------------------------------

MISTAKES = {
    "unknown key": ("fit: {learning_rat: 0.1}", "fit.learning_rat: unknown key (did you mean learning_rate?)"),
    "unknown top key": ("sede: 1", "sede: unknown key (did you mean seeds?)"),
    "number as text": (
        "fit: {learning_rate: 5e-5}",
        "fit.learning_rate",
        "'5e-5' (YAML reads a number such as 5e-5 as text: write 5.0e-5)",
    ),
    "number for a truth": ("tracking: {enabled: 1}", "tracking.enabled", "received 1"),
    "nothing for a number": ("fit: {learning_rate: }", "fit.learning_rate", "received None"),
    "reversed range": (
        "search: {variables: {drag: {low: 5, high: 1}}}",
        "search.variables",
        "drag: 0 <= low < high is required, received [5.0, 1.0]",
    ),
    "always tied": (
        "search: {rollouts: 9, tied_rollouts: 9}",
        "tied_rollouts must be below rollouts (9), received 9",
    ),
    "start outside": ("search: {variables: {drag: {start: 60}}}", "variables.drag: start must be in [0.05, 50.0], received 60.0"),
    "log scale from zero": (
        "search: {variables: {stiffness: {low: 0.0}}}",
        "variables.stiffness: scale log requires a positive low, received 0.0",
    ),
    "a fixed stranger": ("search: {fixed: [mass]}", "fixed: entries must be different variables (", "received ['mass']"),
    "unknown key in a list": (
        "aims: [{method: a, baseline: b, ratio: 1.0, bellow: 1}]",
        "aims.0.bellow: unknown key (did you mean below?)",
    ),
    "a password on command lines": (
        "tracking: {uri: 'http://me:secret@host:5000'}",
        "tracking: uri: must not contain a password, because ps and logs would show it; set PGPASSWORD, ~/.pgpass or",
        "***@host",
    ),
    "duplicate seeds": ("seeds: [1, 1]", "seeds: entries must differ, received [1, 1]"),
    "a word among seeds": ("seeds: 0,a", "seeds: integers separated by commas are required, as in seeds=0,1,2, received '0,a'"),
    "a date": ("results: 2026-01-01", "values must be plain YAML"),
}


def test_the_results_folder_has_one_spelling():
    assert load("results: ./out//a/").results == "out/a"


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named(name):
    text, *parts = MISTAKES[name]
    message = refused(text)
    for part in parts:
        assert part in message


def test_all_problems_are_listed_at_once():
    message = refused("fit: {epochs: x, horizon: -1}\ntoy: {frames: 2}\n")
    for path in ("fit.epochs", "fit.horizon", "toy.frames"):
        assert path in message
    assert "See config/README.md" in message


@pytest.mark.parametrize("name", ["../up", "a b", "", "a/b", ".hidden", "-x", "a;rm", "é", "a\n", "x" * 81, "$HOME", "a*"])
def test_unsafe_names(name):
    """Names become folders and command-line words."""
    for key in ("scenarios", "methods"):
        with pytest.raises(InputError, match=f"{key}.0"):
            parse(Config, yaml.safe_load(MINIMAL) | {key: [name]}, "config.yaml")
    assert not artifacts.SAFE_NAME.fullmatch(name)


@given(st.text(max_size=90))
def test_configuration_and_artifacts_agree_on_names(name):
    try:
        parse(Config, {"scenarios": [name], "methods": ["ours"]}, "config.yaml")
        accepted = True
    except InputError:
        accepted = False
    assert accepted == bool(artifacts.SAFE_NAME.fullmatch(name))


def commanded(*entries):
    """Values that the workflow reads from `--config`, by Snakemake's parser."""
    return config.of_command_line(parse_config(entries))


def test_values_of_the_command_line_are_what_yaml_says():
    """Snakemake hands `--config 'fit={epochs: 60}'` over with the number as text, and true, false and null everywhere."""
    values = commanded("fit={epochs: 60, field: {triplane: false, resolution: 8}, learning_rate: 5.0e-5, loss_unit: m}")
    assert values == {"fit": {"epochs": 60, "field": {"triplane": False, "resolution": 8}, "learning_rate": 5e-5, "loss_unit": "m"}}
    entries = ["transfers=null", "data_root=null", "compare_with=null", "tune=null", "scenarios=[0, rope, 2020-01-01]", "seeds=0,1"]
    made = parse(Config, commanded(*entries), "--config")
    assert (made.transfers, made.data_root, made.compare_with, made.tune) == (None, None, None, None)
    assert (made.scenarios, made.seeds) == (("0", "rope", "2020-01-01"), (0, 1))
    assert commanded("search={ranges: {drag: [0, null]}}") == {"search": {"ranges": {"drag": [0, None]}}}


@pytest.mark.parametrize("entry", ["images=true", "images=True", "images=null", "results=null", "device=false", "clusters=null"])
def test_a_word_that_a_setting_cannot_have_is_named_as_it_is_read(entry):
    key, _, word = entry.partition("=")
    with pytest.raises(InputError, match=rf"--config: \s*{key}: .*received {yaml.safe_load(word)}"):
        parse(Config, commanded(entry), "--config")


def test_the_home_folder_may_be_written_as_a_tilde(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    made = config.parse(config.Config, {"results": "~/x/", "data_root": "~/data"}, "--config")
    assert (made.results, made.data_root) == ("/home/me/x", "/home/me/data")


def test_many_names_are_shortened():
    assert listed(["a", "b"]) == "a, b"
    assert listed(range(100)) == "0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11 and 88 more"


# The dial ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effort", EFFORTS)
def test_an_effort_sets_its_sizes_and_nothing_else(effort):
    made, plainly = load(f"effort: {effort}\n"), plain(load(""))
    config.merge(plainly, sizes(effort) | {"effort": effort})
    assert plain(made) == plainly
    # What a record holds is read back as it is.
    assert parse(Config, plain(made), "again") == made


@with_extensions
def test_the_sizes_of_the_paper_are_the_defaults_but_for_synthetic_pictures():
    assert plain(load("effort: paper\nsynthetic: {size: demo}\n")) == plain(load("")) | {"effort": "paper"}
    assert (Config().clusters, field.ADAPTIVE_FACTOR, field.FIELD_CHANNELS, field.FIELD_HIDDEN, field.FIELD_LAYERS) == (
        5,
        0.85,
        32,
        128,
        3,
    )


def test_a_key_that_is_given_wins_over_the_effort():
    made = load("effort: quick\nfit: {epochs: 7}\nperception: {sample: {nodes: null}}\n")
    assert (made.fit.epochs, made.perception.sample.nodes, made.search.rollouts) == (7, None, 88)


def test_the_demo_is_quick_and_the_synthetic_benchmark_normal():
    for name, effort in (("demo", "quick"), ("synthetic", "normal")):
        values = config.read_yaml(ROOT / "config" / "data" / f"{name}.yaml")
        assert values["effort"] == effort
        # Whatever the dial sets, these files leave to it.
        given = [
            path for path in EFFORT_SIZES if functools.reduce(lambda part, key: part.get(key, {}), path.split("."), values) != {}
        ]
        assert given == []
