"""Spring-Gaus: anchors with directed springs move splats; their parameters are trained on silhouettes.

setup: the training problem from a capture's masks, splats or points. train: epochs over the training frames. predict: the rollout.
graph, kernels, solver, reference: anchors and their motion. model: what is saved. objectives, silhouettes, vgg16: losses.
What differs from the public code, and what was measured: `neuspring/baselines/README.md`.
"""
