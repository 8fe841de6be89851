"""Numbers: metrics and their averages, how sure they are, the paper's values, conformance with the released results.

- `metrics`: `METRICS` declares every metric; Chamfer distance, track error, averages; `carried`: points that move with nodes.
- `pictures`, `lpips`: scores of pictures.
- `statistics`: 95 % intervals, paired differences, ratios over objects, aims.
- `runs`: runs as tables; `failures`: averages without and with failed runs.
- `paper`: what the paper printed, and which methods stand in its tables.
- `released`: checks against the released data, simulator and splats.
"""
