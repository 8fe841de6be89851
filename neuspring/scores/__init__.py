"""Scores: metrics, the long table of a benchmark, averages and their intervals, the paper's values.

- `metrics`: the registry `METRICS` and the scores of a run; `carried`: points that move with nodes.
- `pictures`, `lpips`: image metrics.
- `table`: the long table; `queries`: averages, duels of methods and failures.
- `statistics`: ratios over objects, paired differences, aims, 95 % intervals.
- `paper`, `study`: the published values, and ours side by side with them.
"""
