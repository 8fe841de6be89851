"""GS-Dynamics: a graph network predicts the motion of particles for each centimeter of hand motion.

`model` has presets, graph, network, the saved model and the rollout. `train` has the training data, batches, losses and epochs.
`README.md` lists the differences from the public code; the results are in `README.md` of `neuspring/baselines`.
"""
