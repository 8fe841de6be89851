"""From cameras and others to a capture folder: `neuspring make-capture` and `neuspring cut-capture`.

- `formats`: a file for each form of pictures: folder, video, ROS bag, PhysTwin's raw layout. `feeds`: pairs of color and depth.
- `forms`: files of intrinsics and poses. `lenses`: distortion, poses by a board. `table`: unit of depth, the table by its planes.
- `moments`: pictures of the same moment. `poses`: frames that are kept, and where the cameras are.
- `film`: checks of the files. `make`: all of it. `cut`: some frames of a capture. `commands`: the command line.
"""
