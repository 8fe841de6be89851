"""Read points in space and PhysTwin's data as observations or captures, and check any data folder.

- `points`: controllers, nodes and annotated points in space.
- `phystwin`: processed cases. `phystwin_raw`: PhysTwin's raw layout.
- `check`: findings about a folder of data.
"""
