"""Hypothesis draws the same examples in every run: what fails on one machine fails on all.

To look for new examples: `pytest --hypothesis-profile default`.
"""

from hypothesis import settings

settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")
