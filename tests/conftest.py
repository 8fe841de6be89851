"""Hypothesis draws the same examples in every run, and none has a deadline: what fails on one machine fails on all.

To look for new examples: `pytest --hypothesis-profile default`.
"""

from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")
