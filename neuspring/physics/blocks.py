"""Springs and colliding pairs of one twin, eight at a time, with the vector instructions of a CPU.

A block of eight gathers points, transposes them to columns x, y and z, computes on columns, and transposes the results back.
Equations and order of sums are those of `springs.py` and `collision.py`. So a twin's numbers are the same, bit for bit, alone and
in lanes. Warp has no vectors across the elements of an array, so this is C++ for its compiler (`wp.func_native`).

The last block of a row reads beyond the end of the row, but writes nothing there. Arrays have `BEHIND` additional elements for
this.
"""
# No postponed annotations here: Warp reads the evaluated types of the closures below.

import functools
from typing import Any

import warp as wp

from neuspring.physics.arrays import structs
from neuspring.physics.lanes import MIN_SPRING_LENGTH
from neuspring.physics.motion import APPROACH, MIN_TANGENT

# A GPU has one thread per node and never calls this code.
_COLUMNS = """
#ifdef __CUDA_ARCH__
    __trap();
#else
    typedef %s real;
    typedef real wide __attribute__((ext_vector_type(8)));
    typedef real point __attribute__((ext_vector_type(4)));  // x, y, z, and a number that means nothing
    const real shortest = %r, approach = %r, slowest = %r, zero = 0, one = 1;
    struct Columns {
        wide x, y, z;
        Columns operator+(Columns b) const { return {x + b.x, y + b.y, z + b.z}; }
        Columns operator-(Columns b) const { return {x - b.x, y - b.y, z - b.z}; }
        Columns operator*(wide s) const { return {x * s, y * s, z * s}; }
        Columns operator/(wide s) const { return {x / s, y / s, z / s}; }
    };
    auto dot = [](Columns a, Columns b) { return a.x * b.x + a.y * b.y + a.z * b.z; };
    auto norm = [&](Columns a) { return __builtin_elementwise_sqrt(dot(a, a)); };
    auto at_least = [](wide a, real least) { return a > least ? a : wide(least); };
    auto load = [](const real* from) { point p; __builtin_memcpy(&p, from, sizeof p); return p; };
    auto store = [](real* to, point p) { __builtin_memcpy(to, &p, 2 * sizeof(real)); to[2] = p.z; };
    auto all = [](point p) { return Columns{wide(p.x), wide(p.y), wide(p.z)}; };
    auto columns = [&](const real* from, auto place) {
        wide pair[4], even[2], odd[2];
        for (int k = 0; k < 4; ++k)
            pair[k] = __builtin_shufflevector(load(from + 3 * place(k)), load(from + 3 * place(k + 4)), 0, 1, 2, 3, 4, 5, 6, 7);
        for (int k = 0; k < 2; ++k) {
            even[k] = __builtin_shufflevector(pair[2 * k], pair[2 * k + 1], 0, 8, 1, 9, 4, 12, 5, 13);
            odd[k] = __builtin_shufflevector(pair[2 * k], pair[2 * k + 1], 2, 10, 3, 11, 6, 14, 7, 15);
        }
        return Columns{
            __builtin_shufflevector(even[0], even[1], 0, 1, 8, 9, 4, 5, 12, 13),
            __builtin_shufflevector(even[0], even[1], 2, 3, 10, 11, 6, 7, 14, 15),
            __builtin_shufflevector(odd[0], odd[1], 0, 1, 8, 9, 4, 5, 12, 13)};
    };
    auto points = [](Columns a, point* to) {
        wide even = __builtin_shufflevector(a.x, a.y, 0, 8, 1, 9, 4, 12, 5, 13);
        wide odd = __builtin_shufflevector(a.x, a.y, 2, 10, 3, 11, 6, 14, 7, 15);
        wide pair[4] = {
            __builtin_shufflevector(even, a.z, 0, 1, 8, 8, 4, 5, 12, 12),
            __builtin_shufflevector(even, a.z, 2, 3, 9, 9, 6, 7, 13, 13),
            __builtin_shufflevector(odd, a.z, 0, 1, 10, 10, 4, 5, 14, 14),
            __builtin_shufflevector(odd, a.z, 2, 3, 11, 11, 6, 7, 15, 15)};
        for (int k = 0; k < 4; ++k) {
            to[k] = pair[k].lo;
            to[k + 4] = pair[k].hi;
        }
    };
    auto numbers = [](const real* from, auto place) {
        wide all;
        for (int k = 0; k < 8; ++k)
            all[k] = from[place(k)];
        return all;
    };
    auto size = [](int count, int block) { return count - block < 8 ? count - block : 8; };
"""
_ROW = """
    const real* x = (const real*)wp::address(state.x, slot, 0, g);
    const real* v = (const real*)wp::address(state.v, slot, 0, g);
    const int row = model.first_row.data[g] + i, first = model.rows.data[row], count = model.rows.data[row + 1] - first;
    const int *partners = model.partners.data + first, spring = first - model.first_spring.data[g];
    const real* springs = (const real*)wp::address(model.springs, spring, g);
    const Columns xi = all(load(x + 3 * i)), vi = all(load(v + 3 * i));
"""
_SPRINGS = """
    for (int block = 0; block < count; block += 8) {
        auto upper = [=](int k) { return partners[block + k]; };
        auto own = [=](int k) { return block + k; };
        Columns offset = columns(x, upper) - xi, relative = columns(v, upper) - vi, p = columns(springs, own);
        wide length = norm(offset);
        wide side = p.y < zero ? wide(-one) : wide(one), shorter = p.y * side, strain = length * shorter - one;
        wide acts = p.y < zero && strain > zero ? wide(zero) : wide(one);
"""
_FORCES = (
    _ROW
    + """
    real* force = (real*)wp::address(state.force, 0, g);
    point total = load(force + 3 * i);
"""
    + _SPRINGS
    + """
        Columns d = offset / at_least(length, shortest);
        point f[8];
        points(d * ((p.x * strain + p.z * dot(relative, d)) * acts), f);
        for (int k = 0; k < size(count, block); ++k) {
            real* to = force + 3 * upper(k);
            total += f[k];
            store(to, load(to) - f[k]);
        }
    }
    store(force + 3 * i, total);
"""
)
_FORCES_ADJOINT = (
    _ROW
    + """
    const real* force = (const real*)wp::address(adjoint.force, turn, 0, g);
    real *hx = (real*)wp::address(adjoint.x, 0, g), *hv = (real*)wp::address(adjoint.v, 0, g);
    real* hp = (real*)wp::address(adjoint.springs, spring, g);
    const Columns hi = all(load(force + 3 * i));
    point total_x = load(hx + 3 * i), total_v = load(hv + 3 * i);
"""
    + _SPRINGS
    + """
        Columns c = (hi - columns(force, upper)) * acts;
        wide inverse = one / at_least(length, shortest);
        wide cd = dot(c, offset) * inverse, wd = dot(relative, offset) * inverse;
        wide turned = (p.x * strain + p.z * wd) * inverse, drift = cd * p.z * inverse;
        wide along = cd * (p.x * shorter - turned) - wd * drift;
        point to_x[8], to_v[8], to_p[8];
        points(c * turned + relative * drift + offset * (along * inverse), to_x);
        points(offset * drift, to_v);
        points({strain * cd, length * side * cd, wd * cd}, to_p);
        for (int k = 0; k < size(count, block); ++k) {
            int j = 3 * upper(k), e = 3 * own(k);
            total_x -= to_x[k];
            total_v -= to_v[k];
            store(hx + j, load(hx + j) + to_x[k]);
            store(hv + j, load(hv + j) + to_v[k]);
            store(hp + e, load(hp + e) + to_p[k]);
        }
    }
    store(hx + 3 * i, total_x);
    store(hv + 3 * i, total_v);
"""
)
# The approaching pairs are listed first: one branch per pair would be mispredicted too often.
_PAIRS = """
    const real* x = (const real*)wp::address(state.x, slot, 0, g);
    const real* v = (const real*)wp::address(state.after, inner, 0, g);
    const int *rows = wp::address(model.pair_rows, g, 0), *others = wp::address(model.pair_other, g, 0);
    int *closing = wp::address(model.closing, g, 0), count = 0;
    for (int i = 0; i < model.nodes; ++i) {
        const Columns xi = all(load(x + 3 * i)), vi = all(load(v + 3 * i));
        for (int block = rows[i]; block < rows[i + 1]; block += 8) {
            auto other = [=](int k) { return others[block + k]; };
            auto closer = dot(columns(x, other) - xi, columns(v, other) - vi) < -approach;
            for (int k = 0; k < size(rows[i + 1], block); ++k) {
                closing[2 * count] = i;
                closing[2 * count + 1] = other(k);
                count -= closer[k];  // -1 where it is true
            }
        }
    }
    const real *light = (const real*)wp::address(model.inverse_mass, 0, g), distance = model.distance.data[g].c[0];
    const real e = model.contact_e.data[g].c[0], mu = model.contact_mu.data[g].c[0], more = one + e;
    for (int block = 0; block < count; block += 8) {
        auto lower = [=](int k) { return closing[2 * (block + k)]; };
        auto upper = [=](int k) { return closing[2 * (block + k) + 1]; };
        Columns offset = columns(x, upper) - columns(x, lower), u = columns(v, upper) - columns(v, lower);
        wide length = norm(offset), meets = length < distance ? wide(one) : wide(zero), part(real(0.5)), back(real(0.5));
        if (!model.alike) {
            wide own = numbers(light, lower), other = numbers(light, upper);
            part = own / (own + other);
            back = other / (other + own);
        }
"""
_IMPULSES = (
    """
    real *moving = (real*)wp::address(state.moving, inner, 0, g), *met = (real*)wp::address(state.met, inner, 0, g);
"""
    + _PAIRS
    + """
        Columns n = offset / at_least(length, slowest);
        wide s = dot(u, n);
        Columns ut = u - n * s;
        wide lost = mu * more * __builtin_elementwise_abs(s) / at_least(norm(ut), slowest);
        Columns push = ut * (at_least(one - lost, zero) - one) - n * (more * s);
        point to_lower[8], to_upper[8];
        points(push * part * meets, to_lower);
        points(push * back * meets, to_upper);
        for (int k = 0; k < size(count, block); ++k) {
            int i = lower(k), j = upper(k);
            store(moving + 3 * i, load(moving + 3 * i) + to_lower[k]);
            store(moving + 3 * j, load(moving + 3 * j) - to_upper[k]);
            met[i] += meets[k];
            met[j] += meets[k];
        }
    }
"""
)
_IMPULSES_ADJOINT = (
    """
    const int slot = step, inner = step;
    real *hx = (real*)wp::address(adjoint.x, 0, g), *hv = (real*)wp::address(adjoint.after, 0, g);
    real *to_e = (real*)wp::address(adjoint.contact_e, 0, g), *to_mu = (real*)wp::address(adjoint.contact_mu, 0, g);
    const real *moving = (const real*)wp::address(adjoint.moving, 0, g), *met = (const real*)wp::address(state.met, step, 0, g);
"""
    + _PAIRS
    + """
        Columns own = columns(moving, lower) / at_least(numbers(met, lower), one);
        Columns other = columns(moving, upper) / at_least(numbers(met, upper), one);
        Columns h = (other * back - own * part) * meets;
        wide inverse = one / at_least(length, slowest);
        Columns n = offset * inverse;
        wide s = dot(u, n);
        Columns ut = u - n * s;
        wide t = norm(ut), floored = at_least(t, slowest), speed = __builtin_elementwise_abs(s);
        wide a = at_least(one - mu * more * speed / floored, zero), along = dot(h, n);
        wide slides = a > zero ? wide(one) : wide(zero), turns = t > slowest ? slides : wide(zero);
        wide slope = dot(h, ut) * slides / floored, friction = slope * mu * more;
        wide he = -(s * along) - slope * mu * speed, hmu = -(slope * more * speed);
        wide hs = -((a + e) * along) - (s < zero ? wide(-one) : wide(one)) * friction;
        Columns ht = ut * (friction * turns * speed / (floored * floored));
        wide turned = hs - dot(ht, n);
        Columns hu = h * (a - one) + ht + n * turned;
        Columns hn = h * -((a + e) * s) - ht * s + u * turned;
        point of_x[8], of_v[8];
        points((hn - n * dot(hn, n)) * inverse, of_x);
        points(hu, of_v);
        for (int k = 0; k < size(count, block); ++k) {
            int i = lower(k), j = upper(k);
            store(hx + 3 * j, load(hx + 3 * j) + of_x[k]);
            store(hx + 3 * i, load(hx + 3 * i) - of_x[k]);
            store(hv + 3 * j, load(hv + 3 * j) + of_v[k]);
            store(hv + 3 * i, load(hv + 3 * i) - of_v[k]);
            to_e[i] += he[k];
            to_mu[i] += hmu[k];
        }
    }
"""
)
_END = """
#endif
"""


@functools.cache
def functions(real: Any) -> tuple[Any, Any, Any, Any]:
    """`springs.add_row`, `collision.add_all_pairs`, each followed by its adjoint, for one lane of wp.float32 or wp.float64."""
    Model, State, Adjoint = structs(real, 1)
    head = _COLUMNS % ("float" if real == wp.float32 else "double", MIN_SPRING_LENGTH, APPROACH, MIN_TANGENT)

    @wp.func_native(head + _FORCES + _END)
    def add_row(model: Model, state: State, slot: int, i: int, g: int): ...

    @wp.func_native(head + _FORCES_ADJOINT + _END)
    def add_row_adjoint(model: Model, state: State, adjoint: Adjoint, slot: int, turn: int, i: int, g: int): ...

    @wp.func_native(head + _IMPULSES + _END)
    def add_all_pairs(model: Model, state: State, slot: int, inner: int, g: int): ...

    @wp.func_native(head + _IMPULSES_ADJOINT + _END)
    def add_all_pairs_adjoint(model: Model, state: State, adjoint: Adjoint, step: int, g: int): ...

    return add_row, add_row_adjoint, add_all_pairs, add_all_pairs_adjoint
