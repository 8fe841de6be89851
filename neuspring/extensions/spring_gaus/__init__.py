"""Spring-Gaus: anchors with directed springs move splats; their parameters are trained on silhouettes, or on points.

physics: anchors and their motion. model: what is learned, and the rollout. train: the problem, its losses and epochs.
What differs from the public code, and what was measured: `README.md` here and in `neuspring/baselines`.
"""
