"""Synthetic scenes with known truth: the 22 scenes, simulated by finite elements, filmed, and perception judged by their truth.

- `source`: what the registries of sources and trackers hold; `settings`: the section `synthetic`.
- `make`: a scene -> capture folder and truth; `scenes`: the 22 scenes and their hands.
- `bodies`: cloths, ropes, a package, plush animals; `meshes`: tetrahedra and boxes that they are made of.
- `fem`: Newton's finite elements, two engines; `kernels`: Warp kernels of theirs.
- `truth`: what methods may not read, and where a material point goes; `exact`: exact tracks and the true surface.
- `judge`: the stage that measures perception; `errors`: its numbers.
"""
