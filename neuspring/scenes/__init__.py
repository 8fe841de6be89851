"""Sources of scenarios.

`sources` declares every kind of data and reads the table of scenarios. `toy` makes small scenes without video; `shapes`, `render`
and `rays` are a camera that films meshes.
"""
