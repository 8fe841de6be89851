"""Data: captures and readers, which end in Observations, and the checks of their files.

- `sources`: `SOURCES` declares every kind of data; the table of scenarios.
- `capture`: the capture folder (cameras, frames, masks) and its writer; `check_capture`: its checks.
- `intake`: from what a camera gave to a capture folder; `plausible`: a capture against the world.
- `phystwin`, `phystwin_raw`, `mocap`: readers; `released`, `cases`: what PhysTwin released, and the table of its 22 cases.
- `check`, `departure`, `calibration`: checks of a layout, what they report, the rules for cameras.
- `unpickle`, `mesh_file`, `json_file`: files of other programs. Pickles are only read through `unpickle`.
- `fetch`: the released archives; `synthetic`: scenes with known truth; `tables`: CSV tables that ship.

Importing this package loads none of them.
"""
