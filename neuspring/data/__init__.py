"""Data that everything is made of: the capture folder, and pickles of others without their code.

- `camera`: a calibrated camera, its lens, a plane that it sees. `capture`: the capture folder (cameras, frames, masks) and its
  writer.
- `images`, `frames`: its pictures, and what several steps do with them. `results`: what the steps of perception hand on.
- `c3d`: markers of motion capture. `unpickle`: the only way in which pickles are read. `tables`: CSV tables that ship.

Importing this package loads none of them. README.md here is the page for users of captures.
"""
