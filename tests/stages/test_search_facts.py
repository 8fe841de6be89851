"""Additional facts in the record of a search."""

import pandas as pd

from neuspring.twin.candidates import CMAES
from neuspring.twin.search import at_ends

VARIABLES = ("stiffness", "dashpot", "drag", "contact_friction")


def trace(*rows):
    """Rows of stage, cost, and the normalized variables."""
    return pd.DataFrame(rows, columns=["stage", "cost", *(f"normalized.{name}" for name in VARIABLES)])


def test_variables_at_the_ends_of_their_ranges_are_named():
    best = (CMAES, 1.0, 0.995, 0.5, 0.002, 1.0)
    assert at_ends(trace((CMAES, 2.0, 0.5, 1.0, 0.5, 0.5), best), VARIABLES) == ["stiffness", "drag"], "contact is left out"
