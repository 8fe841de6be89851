"""From what a camera gave to a capture folder (`neuspring make-capture`).

- `feeds`: folders and videos, as pairs of color and depth; RealSense files; PhysTwin's raw layout.
- `lenses`: intrinsics, distortion, files of poses, poses by a board. `depth`: its unit, planes in it, the table among them.
- `poses`: which frames are kept, what was seen in a few, where the cameras are.
- `make`: all of it, as a library function; `CHECKS` lists what is said of the files, by name and level.
"""
