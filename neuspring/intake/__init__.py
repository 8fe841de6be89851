"""From what cameras, motion capture and others gave to a capture folder or observations.

- `formats`: a file for each form of pictures: folder, video, bag, PhysTwin's raw layout. `feeds`: pairs of color and depth.
- `lenses`: intrinsics, distortion, files of poses, poses by a board. `depth`: its unit, planes in it, the table among them.
- `moments`: which pictures show the same moment. `poses`: which frames are kept, what was seen in a few, where the cameras are.
- `film`: what is odd in the files. `make`: all of it, as `neuspring make-capture` calls it. `cut`: some frames of a capture.
- `points`: hands, nodes and points in space. `phystwin`: processed cases. `check`: what is wrong with a folder of data.
"""
