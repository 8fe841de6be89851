"""GS-Dynamics: a graph network predicts where particles go when the hands move a centimeter further.

tracks, windows: what training sees. objective, train: losses and updates. predict, propagate: the rollout of all structure points.
graph, network, model, rules: edges, layers, what is saved, presets.
What differs from the public code, and what was measured: `neuspring/baselines/README.md`.
"""
