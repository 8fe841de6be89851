"""One color camera without depth: masks from a user's marks, a supposed shape, and what the image alone says of object and hands.

| module | content |
|---|---|
| `backends` | entry points: the segmenter `marks`, the lifter of captures with `depth: none` |
| `segment` | marks on a few frames -> labels and doubt of every frame (also with depth) |
| `seeds`, `colors`, `solve` | evidence of marks; of colors; a frame from its marks, or from the one beside it |
| `lift` | the object of frame 0 on the table, silhouettes and tracks in the image |
| `hands`, `given` | hands in the image; nodes that the capture brings |
| `checks` | what one picture cannot say |
"""
