"""Appearance: Gaussian splats, their rasteriser, training on frame 0, and skinning to the nodes of a twin."""
