"""Synthetic scenes with known truth: 22 scenes, simulated with finite elements and rendered as RGBD video.

- `source`: entries of the registries of sources and trackers. `settings`: the section `synthetic`.
- `make`: writes the capture folder and the truth of a scene. `scenes`: the 22 scenes and their hands.
- `bodies`: cloths, ropes, a package, plush animals. `meshes`: their tetrahedra and boxes.
- `fem`: two finite-element engines of Newton. `kernels`: Warp kernels of these engines.
- `truth`: the truth, which methods must not read, and motion of material points. `exact`: exact tracks and the true surface.
- `judge`: the stage that measures perception against the truth. `errors`: its error measures.
"""
