"""Conformance with PhysTwin's release: one set of checks, for `neuspring check-data` (1 to 4) and `verify-released` (1 to 6).

- `run`: the checks and their order, `verify_released` with its report, `check` of a data folder (checks 1 to 4, as findings).
- `checks`: 1 sizes and frame 0, 2 springs, 3 scores of the prediction, 4 deprojection, 5 scores of pictures, 6 replay; a finding
  and its verdict, the published numbers, means over scenarios.

The checks are written to the described layout and tried on stand-ins only: the released archives have not been met yet.
"""
