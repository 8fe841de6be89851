"""From cameras to a capture folder: `neuspring make-capture` and `neuspring cut-capture`.

- `rig`: what the user states (rig.json), other programs' keys, and lenses. `streams`: which images belong together.
- `formats`: a file for each form of images: folder, video, ROS bag, PhysTwin's raw layout. `poses`: of cameras.
- `make`: all of it. `cut`: some frames of a capture. `commands`, `options`: the command line.
"""
