"""Conformance with what PhysTwin released: springs, scores, deprojection, pictures and replays, beside the published numbers.

Written to the described layout and tried on stand-ins in that layout only: the released archives have not been met yet.
"""
