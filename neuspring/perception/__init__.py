"""Raw RGBD video -> observations. README.md here is the page for users.

| step | modules |
|---|---|
| segment | `segment_given`, `segment_opencv`, `segment_marks`, `segment_sam2`: which pixels show the object and the hands |
| track | `track_opencv`, `track_cotracker`, `track_truth`: where the pixels of frame 0 go |
| lift | `lift`: tracks of all cameras -> points in the world; `controllers`: which points of the hands move the object, and when |
| shape prior | `shape` (visual hull, or none), `shape_mesh` (a mesh from elsewhere): what no camera sees |
| sample | `sample`: the structure points of a twin, and observations |
| color alone | `color`, `color_hands`: lift and shape prior of one camera without depth |
| look, judge | `findings`: what the steps notice about their own results; `figures`: pictures; `judge`: errors against the truth |

`backends`: `BACKENDS` declares the backends of segmentation and tracking. `results` declares what the steps hand on: `Masks`,
`PixelTracks`, `LiftedTracks`, `ShapePrior`. `marks`: masks from a few marks of a user. `annotate`: the page on which a person makes
masks and ground-truth tracks.
"""
