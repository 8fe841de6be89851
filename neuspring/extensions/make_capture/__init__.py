"""From cameras to a capture folder: `neuspring make-capture` and `neuspring cut-capture`.

- `rig`: rig.json, keys of other programs, and lenses. `poses`: poses of the cameras.
- `streams`: image streams, and which images belong together.
- `formats`: one file per input format: image folder, video, ROS bag, PhysTwin's raw layout.
- `make`: writes a capture. `cut`: copies some frames of a capture. `commands`, `options`: the command line.
"""
