"""Spring-mass simulation: one term = one kernel, its adjoint and its launcher, in Warp; the float64 reference in NumPy.

Order of operations in a substep (that of the released PhysTwin code): spring and dashpot forces, gravity and drag on the velocity,
self-collision impulses, ground contact and position update (symplectic Euler).
"""
