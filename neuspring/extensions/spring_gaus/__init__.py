"""Spring-Gaus: anchors with directed springs move splats; their parameters are trained on silhouettes or on points.

`physics` has anchors and their motion, `model` the trained parameters and the rollout, `train` the losses and epochs.
`README.md` lists the differences from the public code; the results are in `README.md` of `neuspring/baselines`.
"""
