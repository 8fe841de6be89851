"""Numbers: metrics and their averages, the bootstrap, the paper's values, conformance with the released results.

- `metrics`: `METRICS` declares every metric; Chamfer distance, track error, averages.
- `pictures`, `lpips`, `lpips_weights`: scores of pictures.
- `statistics`: 95 % intervals and paired differences.
- `runs`: runs as tables; `failures`: averages without and with failed runs.
- `paper`, `studies`: what the paper printed, and which methods stand in its tables.
- `released`: checks against the released data, simulator and splats.
"""
