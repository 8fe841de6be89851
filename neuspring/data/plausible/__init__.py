"""Plausibility of a capture against the world, before any cost: `table` (z = 0, up, poses, unit), `masks` (object and hands over
the video), `things` (their size, depth and distance), `views` (cameras against each other).
"""
