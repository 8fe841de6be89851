"""What everything stands on: the nouns, their files and records, errors, provenance, progress, and where things are computed.

Importing it loads neither torch nor Warp; only `device` and reading weights do.
"""
