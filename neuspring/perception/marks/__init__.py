"""Masks from a few marks.

marks       the file marks.json, and its marks as pixels
colors      colors of nothing, object and hands, and of the background
solve       a frame: from its marks, or from the one beside it
carry       marks on a few frames -> labels and doubt of every frame
store       mask/ of a capture
"""
