"""The spring-mass simulator in Warp, its adjoint, and its float64 specification in NumPy.

springs, velocity, collision, position: one term each, a file with its kernels, their adjoints and their launchers; contact: the
response that collision and position share. solver: the frame, which launches the terms in order. autograd: a frame as a
differentiable function of torch tensors. buffers: arrays and captured graphs. reference: the specification. stability: whether the
substep is small enough. Kernels take their arguments as model, state, out.

For others: solver.FrameSolver and Parameters; autograd.simulate_frame, pack and twin_tensors; reference; stability.
"""
