"""Raw RGBD video -> observations. README.md here is the page for users.

| step | modules |
|---|---|
| segment | `segment_given`, `segment_opencv`, `segment_sam2`, `marks`: which pixels show the object and the hands |
| track | `track_opencv`, `track_cotracker`: where the pixels of frame 0 go |
| lift | `lift`: tracks of all cameras -> points in the world; `controllers`: which points of the hands move the object, and when |
| shape prior | `shape` (visual hull, a mesh from elsewhere, or none): what no camera sees |
| sample | `sample`: the structure points of a twin, and observations |
| color alone | `color`, `color_hands`: lift and shape prior of one camera without depth |
| look, judge | `findings`: what the steps notice about their own results; `figures`: pictures; `judge`: errors against the truth |

`backends`: `BACKENDS` declares the backends of segmentation and tracking. `results` declares what the steps hand on: `Masks`,
`PixelTracks`, `LiftedTracks`, `ShapePrior`. `frames`: frames of a camera, for all steps. `marks`: masks from a few marks of a user.
`annotate`: the page on which a person makes masks and ground-truth tracks.
"""
