"""A rope that gives: every rod of it lengthens with the pull at the mount. Equations: :class:`sim.params.RopeParams`.

With l the length of a rod and l' its growth, the lower end of a rod moves at ``l u + l' n`` and is accelerated by ``2 l' u``
besides; what hangs there and the rod's own mass take part in it.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from sim.kernels.rope.algebra import sym_mul
from sim.kernels.structs import Types


@wp.func
def rigid_moment(rope: Any, i: int, last: int, moment: Any, u: Any, d: Any, o: Any, cm: Any):
    """Right-hand side of rod i's moment balance; a rope that keeps its length adds nothing."""
    return moment


@wp.func
def rigid_force(rope: Any, i: int, last: int, force: Any, u: Any, d: Any, o: Any, m: Any):
    """Force that rod i asks for at its upper joint, likewise."""
    return force


@wp.func
def rigid_tip(rope: Any, acc: Any, u: Any):
    """Acceleration of a rod's lower end, likewise."""
    return acc


@wp.func
def rigid_center(rope: Any, i: int, last: int, acc: Any, u: Any):
    """Acceleration of a rod's centre of mass, likewise."""
    return acc


@wp.func
def rigid_speed(rope: Any, vel: Any, n: Any):
    """Velocity of a rod's lower end, likewise."""
    return vel


@wp.func
def growing(rope: Any, u: Any):
    """Coriolis acceleration ``2 l' u`` of the lower end of a rod that lengthens."""
    return (type(rope.strain_rate)(2.0) * rope.strain_rate * rope.segment_length) * u


@wp.func
def centre_share(rope: Any, i: int, last: int):
    """Part of a rod's lengthening that its centre of mass follows."""
    if i == last:
        return rope.stretched_share
    return type(rope.stretched_share)(0.5)


@wp.func
def giving_moment(rope: Any, i: int, last: int, moment: Any, u: Any, d: Any, o: Any, cm: Any):
    if rope.compliance == type(rope.compliance)(0.0):  # lanes of a replay differ in it
        return moment
    e = growing(rope, u)
    return moment - rope.segment_length * sym_mul(d, o, e) - (cm * centre_share(rope, i, last)) * e


@wp.func
def giving_force(rope: Any, i: int, last: int, force: Any, u: Any, d: Any, o: Any, m: Any):
    if rope.compliance == type(rope.compliance)(0.0):
        return force
    e = growing(rope, u)
    return force + sym_mul(d, o, e) + (m * centre_share(rope, i, last)) * e


@wp.func
def giving_tip(rope: Any, acc: Any, u: Any):
    return acc + growing(rope, u)


@wp.func
def giving_center(rope: Any, i: int, last: int, acc: Any, u: Any):
    return acc + centre_share(rope, i, last) * growing(rope, u)


@wp.func
def giving_speed(rope: Any, vel: Any, n: Any):
    return vel + (rope.strain_rate * rope.segment_length) * n


def of(extensions: frozenset[str]) -> SimpleNamespace:
    """Warp functions of the recursion's additions; each returns what it is given where the rope keeps its length."""
    if "compliance" in extensions:
        return SimpleNamespace(
            moment=giving_moment, force=giving_force, tip=giving_tip, center=giving_center, speed=giving_speed
        )
    return SimpleNamespace(moment=rigid_moment, force=rigid_force, tip=rigid_tip, center=rigid_center, speed=rigid_speed)


def build_stretch(t: Types, chain: SimpleNamespace, extensions: frozenset[str]):
    """Warp function ``stretched(natural, now, stiffness, u, h)`` -> the rope under its pull, ``now`` what it was h seconds before.

    With h 0 it is at rest. A rope that keeps its length is returned as it is.
    """
    real, vec3, Rope, L = t.real, t.vec3, t.Rope, chain.segments

    @wp.func
    def keeping(natural: Rope, now: Rope, stiffness: wp.array(dtype=real), u: wp.array(dtype=vec3), h: real):
        return now

    @wp.func
    def stretched(natural: Rope, now: Rope, stiffness: wp.array(dtype=real), u: wp.array(dtype=vec3), h: real):
        if natural.compliance == real(0.0):
            return now
        out = natural
        one = real(1.0)
        pull = wp.max(chain.pull(now, stiffness, u), real(0.0))
        out.strain = natural.compliance * pull / (natural.segment_length * real(float(L)))
        if h > real(0.0):
            out.strain_rate = (out.strain - now.strain) / (h * (one + out.strain))
        out.segment_length = natural.segment_length * (one + out.strain)
        longer = out.segment_length - natural.segment_length
        rope_part = natural.segment_mass * natural.segment_length * natural.segment_length / real(3.0)
        out.segment_inertia = natural.segment_inertia * (one + out.strain) * (one + out.strain)
        out.payload_arm = natural.payload_arm + longer
        out.last_center = natural.last_center + natural.stretched_share * longer
        ball = natural.payload_mass * (out.payload_arm * out.payload_arm - natural.payload_arm * natural.payload_arm)
        out.last_inertia = natural.last_inertia + rope_part * ((one + out.strain) * (one + out.strain) - one) + ball
        return out

    return stretched if "compliance" in extensions else keeping
