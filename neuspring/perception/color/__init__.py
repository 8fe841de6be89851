"""Captures of color alone: one calibrated camera, the table known. Frame 0 in the world, hands and evidence in the image."""
