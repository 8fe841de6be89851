"""One color camera without depth: masks from annotations, an assumed shape, and image evidence of object and hands.

| module | content |
|---|---|
| `backends` | entry points: the segmenter `marks`, the lifter of captures with `depth: none` |
| `segment` | annotations of a few frames -> labels and doubt of all frames (also with depth) |
| `seeds`, `colors` | evidence of annotations; of colors and background |
| `solve` | labels of a frame, from its annotations or from the neighboring frame |
| `first_frame`, `lift` | shape of the object in frame 0; tracks and silhouettes in the image |
| `hands`, `given` | hands in the image; nodes that the capture contains |
| `checks` | checks of pose, tracks and hands |
"""
