"""The report: one HTML file that says whether the paper was reproduced, and shows everything a results folder holds.

It needs no network and no script, is made from what is on disk, also of a benchmark that is half done, and lists what it cannot
read.
"""

from neuspring.report.page.page import Options, write

__all__ = ["Options", "write"]
