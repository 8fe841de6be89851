"""Raw RGBD video -> observations. README.md here is the page for users.

| step | modules |
|---|---|
| segment | `segment_given`, `segment_opencv`, `segment_marks`, `segment_sam2`: which pixels show the object and the hands |
| track | `track_opencv`, `track_cotracker`, `track_truth`: where the pixels of frame 0 go |
| lift | `lift`, `controllers`: tracks of all cameras -> points in the world, and which points of the hands move the object |
| | `release`: when hands let go |
| shape prior | `shape_prior` (visual hull, or none), `shape_mesh` (a mesh from elsewhere): what no camera sees |
| | `shape_back`: where one camera's hull ends; `shape_seen`: which part of a shape was seen |
| sample | `sample`: the structure points of a twin |
| findings | `look`, `look_world`: what the steps notice about their own results |
| look, judge | `figures`: pictures of each step; `judge`: errors against the truth of a synthetic capture |

`marks`: masks from a few marks of a user. `segment_pieces`: pieces of automatic masks over the video. `backends`: `BACKENDS`
declares the backends of segmentation and tracking; `mask_facts`: quality numbers of masks; `assemble`: observations. `results`
declares what the steps hand on: `Masks`, `PixelTracks`, `LiftedTracks`, `ShapePrior`.
`annotate`: the page on which a person makes masks and ground-truth tracks.
"""
