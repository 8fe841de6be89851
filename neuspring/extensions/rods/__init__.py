"""Cables and ropes as discrete elastic rods. The page for users is README.md.

| modules | content |
|---|---|
| `rod`, `body` | the data of a rod, and the interface of the body |
| `solver`, `nodes` | simulation; nodes that follow the rod |
| `made`, `center_line`, `fit` | the initial rod, search and fit |
| `sources`, `mocap`, `posed`, `checks` | motion capture and its checks |
| `export` | MuJoCo |
| `metric`, `clips` | DEFORM's benchmark |
"""
