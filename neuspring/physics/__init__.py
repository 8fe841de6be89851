"""The spring-mass simulator in Warp, its adjoint, and its float64 specification in NumPy. README.md here is the page for users.

| content | modules |
|---|---|
| physical parameters: kernel arguments, and how they follow from a material | `parameters` |
| one term each, with its adjoint | `springs`, `motion`, `collision` |
| types of several twins, arrays, a frame as kernels | `lanes`, `arrays`, `frame` |
| springs and colliding pairs of one twin in C++, eight at a time | `blocks` |
| a frame of one or several twins, for torch | `solver`, `union`, `controllers` |
| regions and springs from points | `topology` |
| the specification; the stability bound | `reference`, `stability`, `lanczos` |
"""
