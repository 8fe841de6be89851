"""Masks and ground-truth tracks by hand, in a browser: `neuspring annotate`."""
