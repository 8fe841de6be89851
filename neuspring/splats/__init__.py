"""Appearance: Gaussian splats, trained on frame 0 and carried by the nodes of a twin. README.md here is the page for users.

| what | modules |
|---|---|
| the noun | `model`: `Splats` (a PLY file) and `Gaussians` (tensors); `harmonics`: colors by direction |
| drawing | `rasterize`: the entry, the choice of backend, gsplat, the float64 specification; `view`, `blend`: our backend |
| training | `train`, `losses` |
| motion | `skinning`: nodes carry splats |
| pictures of a twin | `draw` |
"""
