"""Data: captures and readers, which end in Observations, and the checks of their files.

- `sources`: `SOURCES` declares every kind of data; the table of scenarios.
- `capture`: the capture folder (cameras, frames, masks) and its writer; `points`: what it may bring in space.
- `intake`: from what a camera gave to a capture folder.
- `phystwin`, `mocap`: readers; `released`: what PhysTwin released beside its data. Pickles are only read through `unpickle`.
- `check`: what is wrong with a folder of data; `plausible`: a capture against the world.
- `fetch`: the released archives; `synthetic`: scenes with known truth; `tables`: CSV tables that ship.

Importing this package loads none of them.
"""
