"""Appearance: Gaussian splats, trained on frame 0 and carried by the nodes of a twin. The page for users is README.md.

| task | modules |
|---|---|
| data | `model`: `Splats` (a PLY file) and `Gaussians` (tensors) |
| rendering | `rasterize`: the entry point, the choice of backend, gsplat |
| the backend `warp` | `view` (ellipses, colors by direction), `blend` |
| training | `train`, `losses` |
| motion | `skinning`: nodes carry splats |
| images of a twin | `draw` |
"""
