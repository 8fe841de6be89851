"""GS-Dynamics: a graph network predicts where particles go when the hands move a centimeter further.

model: presets, graph, network, what is saved, and the rollout. train: what training sees of a capture, batches, losses, epochs.
What differs from the public code, and what was measured: `README.md` here and in `neuspring/baselines`.
"""
