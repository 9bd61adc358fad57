"""Small linear algebra of the rope's recursion."""

from typing import Any

import warp as wp


@wp.func
def sym_mul(d: Any, o: Any, v: Any):
    """Product of the symmetric matrix with diagonal ``d`` and off-diagonals ``o = (xy, xz, yz)`` and a vector."""
    return type(v)(
        d[0] * v[0] + o[0] * v[1] + o[1] * v[2],
        o[0] * v[0] + d[1] * v[1] + o[2] * v[2],
        o[1] * v[0] + o[2] * v[1] + d[2] * v[2],
    )


@wp.func
def tangent_basis(n: Any):
    """Two unit vectors that complete the unit vector n. Source: Duff et al., JCGT 6(1), 2017."""
    one = type(n[0])(1.0)
    sign = one
    if n[2] < n[2] - n[2]:
        sign = -one
    a = -one / (sign + n[2])
    b = n[0] * n[1] * a
    return type(n)(one + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), type(n)(b, sign + n[1] * n[1] * a, -n[1])
