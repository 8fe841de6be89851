"""Perception: raw RGBD video -> observations. README.md is the page for users.

| step | modules |
|---|---|
| segment | `segment_given`, `segment_opencv`, `segment_sam2`, `marks`: the pixels of the object and of the hands |
| track | `track_opencv`, `track_cotracker`: the pixels of frame 0 over time |
| lift | `lift`: tracks of all cameras -> points in the world; `controllers`: points of hands that move the object, and grasps |
| shape prior | `shape` (visual hull, given mesh, or none): the surface that no camera sees |
| sample | `sample`: the structure points of a twin, and observations |
| inspection | `figures` |

`backends` declares the backends: `SEGMENTERS`, `TRACKERS` and `LIFTERS`. `neuspring.data.results` defines the results (`Masks`,
`PixelTracks`, `LiftedTracks`, `ShapePrior`), and `neuspring.checks` their checks. `film` and `masks` carry a user's
annotations (`marks`) through a video. The extension `color_alone` lifts videos of one color camera without depth.
"""
