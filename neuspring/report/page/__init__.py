"""The report: one HTML file that says whether the paper was reproduced, and shows everything a results folder holds.

It needs no network and no script. It is made from what is on disk, also while a benchmark runs, and lists the files that it cannot
read. `page` puts the sections together; `sources` reads the results folder; every other module is a section or a helper of some.
"""

from neuspring.report.page.page import Options, write

__all__ = ["Options", "write"]
