"""Spring-Gaus: anchors with directed springs move splats; their parameters are trained on silhouettes, or on points.

model: anchors in frame 0, what is trained and saved. physics: their motion. losses: silhouettes, points. train: the problem and
its epochs. predict: the rollout. vgg: features for a loss.
What differs from the public code, and what was measured: `neuspring/baselines/README.md`.
"""
