"""Raw RGBD video -> observations. README.md here is the page for users.

| step | modules |
|---|---|
| segment | `segment_given`, `segment_opencv`, `segment_sam2`, `marks`: which pixels show the object and the hands |
| track | `track_opencv`, `track_cotracker`: where the pixels of frame 0 go |
| lift | `lift`: tracks of all cameras -> points in the world; `controllers`: which points of the hands move the object, and when |
| shape prior | `shape` (visual hull, a mesh from elsewhere, or none): what no camera sees |
| sample | `sample`: the structure points of a twin, and observations |
| color alone | `color`, `color_hands`: lift and shape prior of one camera without depth |
| look | `figures`: pictures |

`backends`: `SEGMENTERS` and `TRACKERS` declare the backends. What the steps hand on (`Masks`, `PixelTracks`, `LiftedTracks`,
`ShapePrior`) is in `neuspring.data.results`, and what they notice about it in `neuspring.checks`. `marks`: masks from a few marks
of a user.
"""
