"""Data formats: the capture folder, its images, planes in depth, C3D files, and safe reading of pickles.

- `camera`: a calibrated camera, its lens, and a plane that it sees. `planes`: planes in depth images.
- `capture`: the capture folder (cameras, frames, masks) and its writer. `images`, `frames`: its images.
- `results`: the files that steps of perception pass on.
- `c3d`: markers of motion capture. `unpickle`: the only reader of pickles. `tables`: CSV tables of the package.

Importing this package loads no submodule. README.md is the user's page about captures.
"""
