"""The spring-mass simulator in Warp, its adjoint, and its float64 specification in NumPy. README.md here is the page for users.

| what | modules |
|---|---|
| physical parameters: what the kernels take, how it follows from a material | `parameters` |
| a term each, with its adjoint | `springs`, `motion`, `collision` |
| numbers of several twins, arrays, a frame as kernels | `lanes`, `arrays`, `frame` |
| a frame of one twin or of several, for torch | `solver`, `controllers` |
| points to regions, regions to springs | `topology` |
| the specification; whether the substep is small enough | `reference`, `stability` |
"""
