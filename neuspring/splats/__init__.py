"""Appearance: Gaussian splats, trained on frame 0 and carried by the nodes of a twin. README.md here is the page for users.

| what | modules |
|---|---|
| the noun | `model`: `Splats` (a PLY file) and `Gaussians` (tensors) |
| drawing | `rasterize`: the entry, and the choice of backend; `reference`: its float64 specification |
| | `view`, `project`, `tiles`, `blend`, `harmonics`: our backend; `gsplat_backend`: the other |
| training | `train`, `losses`, `ssim`, `densify` |
| motion | `skinning`, `skinning_kernels`: nodes carry splats |
| pictures of a twin | `draw` |
"""
