"""A file that several tabs edit: stale writes are refused, whoever changed the file."""

import pytest

from neuspring.perception.annotate.document import Document, Stale


@pytest.fixture
def document(tmp_path) -> Document[str]:
    path = tmp_path / "note.txt"
    return Document(path, lambda: path.read_text() if path.exists() else "", path.write_text)


def test_a_write_needs_the_revision_that_it_started_from(document):
    empty, value = document.read()
    assert value == ""
    first = document.write(empty, "one")
    with pytest.raises(Stale):
        document.write(empty, "another tab")
    assert document.read() == (first, "one")
    assert document.write(first, "two") != first


def test_changes_by_other_programs_count(document):
    first = document.write(document.read()[0], "one")
    document.path.write_text("by a script")
    with pytest.raises(Stale):
        document.write(first, "two")
    assert document.read()[1] == "by a script"


@pytest.mark.parametrize("revision", [None, 1, "none", ["none"]])
def test_other_revisions_are_stale(document, revision):
    document.path.write_text("one")
    with pytest.raises(Stale):
        document.write(revision, "two")
