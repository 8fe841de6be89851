"""Studies: the paper's tables, and which method stands in each row."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import StringConstraints

from neuspring.config import parse, read_yaml
from neuspring.config.parse import STRICT, Name
from neuspring.core.artifacts import SAFE_NAME
from neuspring.core.errors import InputError
from neuspring.scores import paper

Text = Annotated[str, StringConstraints(pattern=r"^[^\n]*\S[^\n]*$")]
TAKEN = (
    "summary",
    "scores",
    "runs",
    "averages",
    "differences",
    "held",
    "floors",
    "ratios",
    "seeds",
    "aims",
    "transfers",
    "perception",
    "pictures",
)
"""Names of files that other commands write into the folder of tables."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """A row of studies.yaml: one of the paper's tables, or a table of ours."""

    __pydantic_config__ = STRICT
    title: Text
    reference: str | None
    """Name of the table in paper_tables.csv; null: the paper gives no numbers."""
    baseline: str
    """Label of the row that the others are compared with, on the same scenarios and seeds."""
    rows: dict[Text, Name]
    """The paper's label to a method of methods.yaml. A label that the paper does not have is shown without its values."""

    training: Text = "equal"
    """How the rows are trained, in words."""
    beside: Name | None = None
    """A study of the same labels whose numbers this one shows next to its own: the same rows, trained in another way."""

    def __post_init__(self) -> None:
        if self.baseline not in self.rows:
            raise ValueError(f"baseline: must be a label of rows ({', '.join(self.rows)}), received {self.baseline!r}")
        if len(set(self.rows.values())) != len(self.rows):
            raise ValueError(f"rows: methods must differ, received {list(self.rows.values())}")
        if self.reference is None:
            return
        if self.reference not in paper.tables():
            raise ValueError(f"reference: must be null or one of {', '.join(paper.tables())}, received {self.reference!r}")
        missing = [label for label in dict.fromkeys(label for label, _, _ in self.values) if label not in self.rows]
        if missing:
            raise ValueError(f"rows: the paper's {self.reference} also has {missing}; labels must be spelled as there")

    @property
    def values(self) -> paper.Values:
        """What the paper prints; empty without a reference."""
        return paper.table(self.reference) if self.reference else {}


def read_studies(path: Path) -> dict[str, Study]:
    """The studies of a YAML file by name. Raises InputError."""
    studies = {name: parse(Study, row, f"{path}, study {name}") for name, row in read_yaml(path).items()}
    for name in studies:
        if not SAFE_NAME.fullmatch(str(name)) or name in TAKEN:
            rule = f"letters, digits, _, . and - make the name of a study, and {', '.join(TAKEN)} are taken"
            raise InputError(f"{path}, study {name}", rule, repr(name), "Rename it.")
        beside = studies[name].beside
        if beside is not None and (
            beside == name or beside not in studies or not set(studies[beside].rows) & set(studies[name].rows)
        ):
            rule = "beside: must be another study of this table, with labels of this one"
            raise InputError(f"{path}, study {name}", rule, repr(beside), f"Known: {', '.join(studies)}")
    return studies
