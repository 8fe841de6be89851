"""Sources of scenarios.

`sources` declares every kind of data and reads the table of scenarios; `synthetic` makes scenes whose truth is known, filmed ones
and toys.
"""
