"""Front-to-back blending of ellipses in tiles, and its adjoint: Warp kernels, the same on CPU and CUDA.

For a pixel at u and the ellipses i of its tile in order of depth, with conic Q_i, mean m_i, opacity o_i and feature f_i [4],

    s_i = (u - m_i)^T Q_i (u - m_i) / 2,   a_i = min(alpha_max, o_i exp(-s_i)),   w_i = a_i T_i,   T_(i+1) = T_i (1 - a_i),

gives F = sum_i w_i f_i and T. Ellipses with a_i < alpha_min are skipped; the pixel is done before the first one that would leave
T <= transmittance_min. The adjoint goes back to front and takes T_i = T_(i+1) / (1 - a_i) from the end, with B_i = sum_(j>i) w_j
(f_j . dL/dF) + T dL/dT:

    dL/da_i = T_i (f_i . dL/dF) - B_i / (1 - a_i),   dL/ds_i = -o_i exp(-s_i) dL/da_i,   both zero where a_i is clamped.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any

import warp as wp


@functools.cache
def kernels(real: Any) -> tuple[Any, Any]:
    """(blend, adjoint) kernels for the scalar type `real`, wp.float32 or wp.float64."""
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    one = wp.constant(real(1.0))
    half = wp.constant(real(0.5))

    def blend(
        means: wp.array(dtype=vec2),
        conics: wp.array(dtype=vec3),
        strengths: wp.array(dtype=vec2),
        features: wp.array(dtype=vec4),
        starts: wp.array(dtype=int),
        members: wp.array(dtype=int),
        across: int,
        tile: int,
        alpha_min: real,
        alpha_max: real,
        transmittance_min: real,
        total: wp.array2d(dtype=vec4),
        transmittance: wp.array2d(dtype=real),
        ends: wp.array2d(dtype=int),
    ):
        y, x = wp.tid()  # type: ignore[misc]
        place = vec2(real(x) + half, real(y) + half)
        number = (y // tile) * across + x // tile
        # Both begin as the caller left them: zero and one.
        sum = total[y, x]
        left = transmittance[y, x]
        end = starts[number]
        for k in range(starts[number], starts[number + 1]):
            i = members[k]
            d = place - means[i]
            q = conics[i]
            s = half * (q[0] * d[0] * d[0] + q[2] * d[1] * d[1]) + q[1] * d[0] * d[1]
            strength = strengths[i]
            if s <= strength[1]:
                alpha = wp.min(strength[0] * wp.exp(-s), alpha_max)
                if alpha >= alpha_min:
                    after = left * (one - alpha)
                    if after <= transmittance_min:
                        break
                    sum += features[i] * (alpha * left)
                    left = after
                    end = k + 1
        total[y, x] = sum
        transmittance[y, x] = left
        ends[y, x] = end

    def blend_adjoint(
        means: wp.array(dtype=vec2),
        conics: wp.array(dtype=vec3),
        strengths: wp.array(dtype=vec2),
        features: wp.array(dtype=vec4),
        starts: wp.array(dtype=int),
        members: wp.array(dtype=int),
        across: int,
        tile: int,
        alpha_min: real,
        alpha_max: real,
        transmittance: wp.array2d(dtype=real),
        ends: wp.array2d(dtype=int),
        adj_total: wp.array2d(dtype=vec4),
        adj_transmittance: wp.array2d(dtype=real),
        adj_means: wp.array(dtype=vec2),
        adj_conics: wp.array(dtype=vec3),
        adj_opacities: wp.array(dtype=real),
        adj_features: wp.array(dtype=vec4),
    ):
        y, x = wp.tid()  # type: ignore[misc]
        place = vec2(real(x) + half, real(y) + half)
        number = (y // tile) * across + x // tile
        adj = adj_total[y, x]
        left = transmittance[y, x]
        behind = left * adj_transmittance[y, x]
        count = ends[y, x] - starts[number]
        for step in range(count):
            i = members[starts[number] + count - 1 - step]
            d = place - means[i]
            q = conics[i]
            s = half * (q[0] * d[0] * d[0] + q[2] * d[1] * d[1]) + q[1] * d[0] * d[1]
            strength = strengths[i]
            if s <= strength[1]:
                bell = wp.exp(-s)
                raw = strength[0] * bell
                alpha = wp.min(raw, alpha_max)
                if alpha >= alpha_min:
                    inverse = one / (one - alpha)
                    left = left * inverse
                    weight = alpha * left
                    gain = wp.dot(features[i], adj)
                    adj_alpha = left * gain - behind * inverse
                    behind += weight * gain
                    wp.atomic_add(adj_features, i, adj * weight)
                    if raw <= alpha_max:
                        adj_s = -raw * adj_alpha
                        wp.atomic_add(adj_opacities, i, bell * adj_alpha)
                        pull = vec2(q[0] * d[0] + q[1] * d[1], q[1] * d[0] + q[2] * d[1])
                        wp.atomic_add(adj_means, i, pull * (-adj_s))
                        wp.atomic_add(adj_conics, i, vec3(half * d[0] * d[0], d[0] * d[1], half * d[1] * d[1]) * adj_s)

    unique = wp.kernel(module="unique", enable_backward=False)
    return unique(blend), unique(blend_adjoint)
