"""Appearance: Gaussian splats, trained on frame 0 and carried by the nodes of a twin. README.md here is the page for users.

| what | modules |
|---|---|
| the noun | `model`: `Splats` (a PLY file) and `Gaussians` (tensors) |
| drawing | `rasterize`: the entry, the choice of backend, gsplat, the float64 specification |
| our backend | `view` (ellipses, colors by direction), `blend` |
| training | `train`, `losses` |
| motion | `skinning`: nodes carry splats |
| pictures of a twin | `draw` |
"""
