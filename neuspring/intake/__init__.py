"""From data of cameras, motion capture and others to observations, and findings about them.

- `points`: hands, nodes and points in space. `phystwin`: processed cases. `phystwin_raw`: PhysTwin's raw layout.
- `depth`: planes in depth. `check`: findings about a folder of data.
"""
