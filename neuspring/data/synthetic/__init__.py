"""Synthetic scenes with known truth.

- `make`: a scene -> capture folder and truth; `scenes`: the 22 scenes; `toy`: small scenes without video.
- `goods`, `plush`, `hands`: bodies and hands; `body`, `implicit`, `tetrahedra`: what they are made of.
- `fem`, `fem_model`, `fem_kernels`: Newton's explicit finite elements; `vbd`: a second engine.
- `render`, `render_kernels`, `sensor`: the ray caster, the depth camera's flaws.
- `truth`: what methods may not read; `correspond`, `correspond_kernels`: where a material point goes.
"""
