"""Plausibility of a capture against the world, before any cost: `table` (z = 0, up, poses, unit), `things` (object and hands in the
masks), `views` (cameras against each other), `pieces` (how many objects a mask shows).
"""
