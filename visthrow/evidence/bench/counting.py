"""The part of Warp's language that the simulator's kernels use, in Python numbers that count their operations.

With it in Warp's place, the kernels' own source runs as plain Python: the count follows the code, and its results are
held against the compiled kernel's (a test does). Counted: additions, multiplications, divisions, roots, minima, maxima,
roundings. Not counted: negations, comparisons, absolute values, loads, indices, integers.
"""

import math
from types import SimpleNamespace
from typing import Any

TALLY = {"operations": 0}


def _tick() -> None:
    TALLY["operations"] += 1


class Real:
    """A float that counts."""

    __slots__ = ("v",)

    def __init__(self, v: Any = 0.0):
        self.v = v.v if isinstance(v, Real) else float(v)

    def __add__(self, o):
        _tick()
        return Real(self.v + _raw(o))

    __radd__ = __add__

    def __sub__(self, o):
        _tick()
        return Real(self.v - _raw(o))

    def __rsub__(self, o):
        _tick()
        return Real(_raw(o) - self.v)

    def __mul__(self, o):
        if isinstance(o, Vec):
            return o * self
        _tick()
        return Real(self.v * _raw(o))

    __rmul__ = __mul__

    def __truediv__(self, o):
        _tick()
        return Real(self.v / _raw(o))

    def __neg__(self):
        return Real(-self.v)

    def __lt__(self, o):
        return self.v < _raw(o)

    def __le__(self, o):
        return self.v <= _raw(o)

    def __gt__(self, o):
        return self.v > _raw(o)

    def __ge__(self, o):
        return self.v >= _raw(o)

    def __eq__(self, o):
        return self.v == _raw(o)

    def __ne__(self, o):
        return self.v != _raw(o)

    __hash__ = None

    def __int__(self):
        return int(self.v)

    def __float__(self):
        return self.v


def _raw(x: Any) -> float:
    return x.v if isinstance(x, Real) else float(x)


class Vec:
    """Vector, quaternion (xyzw) or 3x3 matrix (rows) of counting numbers."""

    size = 0

    def __init__(self, *parts: Any):
        self.c = [Real(p) for p in parts] if parts else [Real() for _ in range(self.size)]

    def __getitem__(self, i):
        return self.c[i]

    def __setitem__(self, i, value):
        self.c[i] = Real(value)

    def __add__(self, o):
        return type(self)(*[a + b for a, b in zip(self.c, o.c)])

    def __sub__(self, o):
        return type(self)(*[a - b for a, b in zip(self.c, o.c)])

    def __neg__(self):
        return type(self)(*[-a for a in self.c])

    def __mul__(self, o):
        if isinstance(o, Vec):
            return self._times(o)
        return type(self)(*[a * o for a in self.c])

    __rmul__ = __mul__

    def __truediv__(self, o):
        return type(self)(*[a / o for a in self.c])

    def _times(self, o):
        raise TypeError(f"{type(self).__name__} * {type(o).__name__} is nothing that Warp knows")


class Quat(Vec):
    """Quaternion, xyzw."""

    size = 4

    def _times(self, o):
        (ax, ay, az, aw), (bx, by, bz, bw) = self.c, o.c
        return Quat(
            aw * bx + bw * ax + ay * bz - az * by, aw * by + bw * ay + az * bx - ax * bz,
            aw * bz + bw * az + ax * by - ay * bx, aw * bw - ax * bx - ay * by - az * bz,
        )  # fmt: skip


class Mat33(Vec):
    """3x3 matrix."""

    size = 9

    def rows(self) -> list[list[Real]]:
        return [self.c[0:3], self.c[3:6], self.c[6:9]]

    def _times(self, o):
        if o.size == 3:
            return type(o)(*[_dot(row, o.c) for row in self.rows()])
        columns = list(zip(*o.rows()))
        return Mat33(*[_dot(row, column) for row in self.rows() for column in columns])


def _dot(a, b) -> Real:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:]):
        total = total + x * y
    return total


class Struct:
    """Base of the counted structs: fields by annotation, zero at first."""

    def __init__(self):
        for name, kind in type(self).__annotations__.items():
            setattr(self, name, kind())


class Array:
    """Array of one environment: ``(E,)`` or ``(rows, E)`` with E = 1; loads are copies, as in a kernel."""

    def __init__(self, rows: list, two: bool):
        self._rows, self._two = rows, two
        self.shape = (len(rows), 1) if two else (1,)

    def __getitem__(self, i):
        return copy(self._rows[i[0] if self._two else i])

    def __setitem__(self, i, value):
        self._rows[i[0] if self._two else i] = value


def copy(value: Any) -> Any:
    """Copy what Warp passes by value; anything else as it is."""
    if isinstance(value, Vec):
        return type(value)(*value.c)
    if isinstance(value, Struct):
        twin = type(value)()
        for name in type(value).__annotations__:
            setattr(twin, name, copy(getattr(value, name)))
        return twin
    return value


def _smallest(keep_second):
    def pick(a, b=None):
        if b is None:
            found = a[0]
            for other in a.c[1:]:
                found = pick(found, other)
            return found
        if isinstance(a, Real) or isinstance(b, Real):
            _tick()
        return b if keep_second(_raw(b), _raw(a)) else a

    return pick


_max, _min = _smallest(lambda b, a: b > a), _smallest(lambda b, a: b < a)


def _sqrt(x):
    _tick()
    return Real(math.sqrt(_raw(x)))


def _rounded(function):
    def rounded(x):
        _tick()
        return Real(function(_raw(x)))

    return rounded


def _length(v):
    return _sqrt(_dot(v.c, v.c))


def _cross(a, b):
    (ax, ay, az), (bx, by, bz) = a.c, b.c
    return type(a)(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def _normalize(v):
    size = _length(v)
    return v / size if size > 0.0 else type(v)()


def _quat_to_matrix(q):
    x, y, z, w = q.c
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2, w * x2, w * y2, w * z2
    return Mat33(
        1.0 - (yy + zz), xy - wz, xz + wy, xy + wz, 1.0 - (xx + zz), yz - wx, xz - wy, yz + wx, 1.0 - (xx + yy)
    )


def _rotate(q, v, sign):
    x, y, z, w = q.c
    axis = type(v)(x, y, z)
    along = _dot(axis.c, v.c) * 2.0
    return v * (w * w * 2.0 - 1.0) + axis * along + _cross(axis, v) * (w * 2.0 * sign)


def _inverse(m):
    (a, b, c), (d, e, f), (g, h, i) = m.rows()
    A, B, C = e * i - f * h, f * g - d * i, d * h - e * g
    scale = Real(1.0) / (a * A + b * B + c * C)
    rest = (A, c * h - b * i, b * f - c * e, B, a * i - c * g, c * d - a * f, C, b * g - a * h, a * e - b * d)
    return Mat33(*rest) * scale


def _vector(size: int, _dtype: Any) -> type:
    return _VECTORS.setdefault(size, type(f"Vec{size}", (Vec,), {"size": size}))


def _isfinite(x) -> bool:
    return all(math.isfinite(_raw(c)) for c in (x.c if hasattr(x, "c") else [x]))


_VECTORS: dict[int, type] = {}


def _struct(fields: type) -> type:
    return type(fields.__name__, (Struct,), {"__annotations__": fields.__annotations__})


def _decorator(function=None, **_options):
    return function if function is not None else (lambda f: f)


warp = SimpleNamespace(
    float32=Real, float64=Real, int32=int, func=_decorator, kernel=_decorator, struct=_struct, Kernel=object,
    array=lambda *_, **__: lambda: None, array2d=lambda *_, **__: lambda: None, config=SimpleNamespace(), tid=lambda: 0,
    types=SimpleNamespace(vector=_vector, matrix=lambda shape, _: Mat33, quaternion=lambda _: Quat),
    zeros=lambda shape, dtype: [dtype() for _ in range(shape[0])],
    abs=lambda x: Real(abs(_raw(x))), sqrt=_sqrt, isfinite=_isfinite,
    ceil=_rounded(math.ceil), floor=_rounded(math.floor), max=_max, min=_min,
    clamp=lambda x, low, high: _min(_max(x, low), high), dot=lambda a, b: _dot(a.c, b.c), cross=_cross, length=_length,
    normalize=_normalize, cw_mul=lambda a, b: type(a)(*[x * y for x, y in zip(a.c, b.c)]),
    cw_div=lambda a, b: type(a)(*[x / y for x, y in zip(a.c, b.c)]),
    diag=lambda v: Mat33(v[0], 0, 0, 0, v[1], 0, 0, 0, v[2]),
    skew=lambda v: Mat33(0, -v[2], v[1], v[2], 0, -v[0], -v[1], v[0], 0),
    transpose=lambda m: Mat33(*[x for column in zip(*m.rows()) for x in column]), inverse=_inverse,
    quat_to_matrix=_quat_to_matrix,
    quat_rotate=lambda q, v: _rotate(q, v, 1.0), quat_rotate_inv=lambda q, v: _rotate(q, v, -1.0),
)  # fmt: skip
"""What stands in for the module ``warp``."""
