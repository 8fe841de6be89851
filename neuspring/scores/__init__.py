"""Scores: metrics, the long table of a benchmark, averages and their intervals, the paper's values.

- `metrics`: `METRICS`, the registry of metrics, and scores of a run; `carried`: points that move with nodes; `pictures`, `lpips`.
- `table`: the long table; `queries`: averages, duels of methods, failures on it.
- `statistics`: ratios over objects, paired differences, aims, 95 % intervals.
- `paper`, `study`: what the paper printed, and ours beside it.
"""
