"""Conformance with PhysTwin's release: one set of checks, for `neuspring check-data` (1 to 4) and `verify-released` (1 to 6).

- `run`: the checks and their order, `verify_released`, its report.
- `check_data`: the layout of a data folder (`neuspring.data.check`) and checks 1 to 4, as findings.
- `physics`: 1 sizes and frame 0, 2 springs, 3 scores of the prediction, 6 replay.
- `images`: 4 deprojection, 5 scores of pictures.
- `findings`: a finding and its verdict, the published numbers, means over scenarios.

The checks are written to the described layout and tried on stand-ins only: the released archives have not been met yet.
"""
