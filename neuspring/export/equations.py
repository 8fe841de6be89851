"""What a twin computes, in words and equations for readers who have only the exported files."""

_TEXT = """
Per frame there are `substeps` steps of dt = frame_time / substeps. Step k = 0, 1, ... of a frame does, in this order:

1. Controllers are at begin + (end - begin) u, u = (k + 1) / substeps, with begin and end the rows of `hands` of this frame and of
the next. Nodes are where the step before left them.

2. Spring (i, j): d = (x_j - x_i) / l, l = |x_j - x_i|; force on i: (stiffness (l / rest_length - 1) + dashpot (v_j - v_i) . d) d,
its negative on j. An index of N or more is controller index - N. Its velocity is 0; if controller_velocity is true, that of its
path.

3. A controller whose `holds` is false in this frame or in the next has springs without force in it.

4. w = v + dt (force / mass + (0, 0, -gravity up_sign)).

5. Drag: v' = w exp(-dt drag).

6. If self_collision: pairs of nodes that were closer than contact_distance at the begin of the frame, are so now, and approach
(dx . dv < 0) change their velocity. With n = dx / |dx|, u = v_j - v_i = u_n + u_t, u_n along n, a = max(0, 1 - contact_friction
(1 + contact_elasticity) |u_n| / |u_t|), node i loses the mean over its partners of mass_j / (mass_i + mass_j) (-(1 +
contact_elasticity) u_n + (a - 1) u_t).

7. x' = x + dt v'. If ground, and the step would take a node that moves down below z = 0 (z up_sign < 0): it moves to z = 0, its
velocity becomes (a v_x, a v_y, -ground_elasticity v_z), a = max(0, 1 - ground_friction (1 + ground_elasticity) |v_z| / |v_xy|),
and it goes on for the rest of dt.
"""
EQUATIONS = tuple(" ".join(paragraph.split()) for paragraph in _TEXT.strip().split("\n\n"))
"""A step of the simulator, in its order."""
