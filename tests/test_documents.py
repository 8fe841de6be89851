"""Pages name existing files, folders, headings and configurations, and are short."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from snakemake.cli import get_argument_parser

from neuspring.config import read_yaml

ROOT = Path(__file__).parents[1]
PLACES = ("", ".github", "config", "findings", "results", "results/published/bench", "tests/golden", "workflow")
PAGES = [*(path for place in PLACES for path in sorted((ROOT / place).glob("*.md"))), *sorted((ROOT / "neuspring").rglob("*.md"))]
WRITTEN = [page for page in PAGES if page != ROOT / "config" / "README.md"]
MOST_WORDS, ALL_WORDS = 1_500, 30_000
"""Largest number of words of a hand-written page, and of all pages."""
NUMBERS = re.compile(r"<!-- numbers: (.+?) -->\n+(?:\|.*\n){2}((?:\|.*\n)+)")
"""Files of the numbers of a table, and its lines below the head."""
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?![\w.])")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
PATH = re.compile(
    r"(?<![\w/.])((?:neuspring|workflow|config|tests|results/published)/[\w/.-]*\w\.(?:py|yaml|tsv|smk|csv|md|txt))\b"
)


def without_extensions(names):
    """All names; without those of extensions where their folder was deleted, since pages still say what they were."""
    there = (ROOT / "neuspring" / "extensions").exists()
    return [name for name in names if there or "extensions/" not in name]


def anchors(page):
    """Anchors of the headings of a page, as code hosts make them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    plain = [re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", title).lower() for title in titles]
    return {re.sub(r"[^\w\- ]", "", title).replace(" ", "-") for title in plain}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_and_paths_of_a_page_lead_somewhere(page):
    text, dead = page.read_text(), []
    for target in LINK.findall(text):
        if re.match(r"https?:|mailto:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
            dead.append(target)
    dead += [name for name in PATH.findall(text) if not (ROOT / name).exists()]
    assert not without_extensions(dead)


def test_commands_of_the_workflow_ask_for_targets_that_there_are():
    """Without running them: Snakemake reads a word that belongs to no option as a target."""
    rules = [*(ROOT / "workflow" / "rules").glob("*.smk"), ROOT / "Snakefile"]
    known = {name for path in rules for name in re.findall(r"^\s*rule (\w+):", path.read_text(), re.MULTILINE)}
    known |= set(read_yaml(ROOT / "config" / "studies.yaml"))
    known |= {name for path in (ROOT / "config" / "rows").glob("*.yaml") for name in read_yaml(path).get("studies", {})}
    asked = {}
    for page in PAGES:
        for command in re.findall(r"snakemake ((?:[^`\n\\]|\\\n)*--configfile(?:[^`\n\\]|\\\n)*)", page.read_text()):
            if "..." not in command:
                words = shlex.split(command.replace("\\\n", " "), comments=True)
                found = get_argument_parser().parse_args(words)
                assert all((ROOT / path).is_file() for path in found.configfile), (page, command)
                asked |= {
                    f"{page.relative_to(ROOT)}: {word}": word for word in found.targets if "/" not in word and not word.isupper()
                }
    assert len(asked) > 2
    assert not {place for place, word in asked.items() if word not in known}


def test_the_page_of_configurations_names_every_file_and_no_other():
    page = (ROOT / "config" / "README.md").read_text()
    named = re.findall(r"^\| `(\w+\.yaml)` \|", page.partition("The tables:")[0], re.MULTILINE)
    tables = [path.name for folder in ("data", "studies") for path in (ROOT / "config" / folder).glob("*.yaml")]
    assert sorted(named) == sorted(tables)


def test_pages_are_short():
    """Hand-written pages, without the page of settings, which is generated."""
    words = {page.relative_to(ROOT).as_posix(): len(page.read_text().split()) for page in WRITTEN}
    assert max(words.values()) <= MOST_WORDS, words
    assert sum(words.values()) <= ALL_WORDS, words


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_numbers_of_tables_are_in_the_files_that_they_name(page):
    """As they are shown, or rounded to the shown digits, in m or mm, as fractions or percent."""
    absent = []
    for names, lines in NUMBERS.findall(page.read_text().replace("−", "-")):
        texts = [(ROOT / name).read_text().replace("−", "-") for name in names.split()]
        known = np.abs([float(number) for text in texts for number in re.findall(r"\d+(?:\.\d+)?(?:e-?\d+)?", text)])
        for number in NUMBER.findall(re.sub(r"`[^`]*`|\[[^\]]*\]\([^)]*\)|^\|[^|]*\|", "|", lines, flags=re.MULTILINE)):
            close = 0.51 * 10.0 ** -len(number.partition(".")[2])
            if not any((abs(factor * known - abs(float(number))) <= close).any() for factor in (1, 100, 1000)):
                absent.append(number)
    assert not absent
