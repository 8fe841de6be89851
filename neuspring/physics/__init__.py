"""The spring-mass simulator in Warp, its adjoint, and its float64 specification in NumPy.

springs, velocity, collision, position, obstacles: one term each, a file with the functions of its equations and their adjoints;
contact: the response that the last three share. lanes: the numbers of several twins that all of them compute in. frame: a frame as
kernels, which call the terms in order, for a CPU and for CUDA. arrays: arrays, their layout, captured graphs. solver: a frame of
one twin or of several. population: twins of topologies of their own in one solver. autograd: a frame as a differentiable function
of torch tensors. path: the controllers' way within a frame. grips: controllers that take hold later. reference: the specification.
stability: whether the substep is small enough.

For others: solver.FrameSolver and Parameters; population.solver_of; path.waypoints; grips.Grips; autograd.simulate_frame, pack and
twin_tensors; lanes.WIDTHS; reference; stability.
"""
