"""Synthetic scenes with known truth.

- `make`: a scene -> capture folder and truth; `scenes`: the 22 scenes and their hands; `toy`: small scenes without video.
- `bodies`: cloths, ropes, a package, plush animals; `meshes`: what they and hands are made of.
- `fem`: Newton's finite elements, two engines; `render`: the ray caster and the depth camera; `kernels`: Warp kernels of both.
- `truth`: what methods may not read, and where a material point goes.
"""
