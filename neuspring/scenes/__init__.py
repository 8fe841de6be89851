"""Sources of scenarios.

`sources` declares every kind of data and reads the scenario table. `toy` creates small scenes without video. `shapes`, `render` and
`rays` render meshes as a depth camera sees them.
"""
