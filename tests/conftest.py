"""Hypothesis draws the same examples in every run, without a deadline, so that failures are the same on all machines.

To look for new examples: `pytest --hypothesis-profile default`.
"""

from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")
