"""Numbers: metrics and their averages, how sure they are, the paper's values, conformance with the released results.

- `metrics`: `METRICS`, the registry of metrics; Chamfer distance, track error, averages; `carried`: points that move with nodes.
- `pictures`, `lpips`: scores of pictures.
- `statistics`: 95 % intervals, paired differences, ratios over objects, aims.
- `numbers`: everything that tables show, computed once and kept in one file; `study`, `clips`: the numbers of studies.
- `runs`: runs as tables; `settings`: those that differ between methods; `failures`: averages without and with failed runs.
- `paper`: what the paper printed, and which methods stand in its tables.
- `released`: checks against the released data, simulator and splats.
"""
