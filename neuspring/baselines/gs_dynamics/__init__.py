"""GS-Dynamics: a graph network predicts where particles go when the hands move a centimeter further.

windows: what training sees of a capture. model: presets, graph, network, what is saved. train: batches, losses, epochs.
predict: the rollout of all structure points.
What differs from the public code, and what was measured: `neuspring/baselines/README.md`.
"""
