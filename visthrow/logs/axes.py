"""Signed permutations of axes, written as text.

``"x,-y,-z"`` means that our x, y, z are the source's x, -y and -z. Of the 48 permutations, 24 are
rotations and 24 are mirror images. Onboard-safe.
"""

import re
from itertools import permutations, product

import numpy as np

OURS = "x,y,z"  # no permutation
_AXIS = re.compile(r"[+-]?[xyz]")


def matrix_of(axes: str) -> np.ndarray:
    """Return the matrix of a signed permutation, rotation or mirror image.

    ``v_ours = matrix @ v_source``, shape (3, 3).

    Raises ValueError: the text is not x, y and z once each, with or without a sign.
    """
    words = [word.strip() for word in axes.split(",")]
    if (
        len(words) != 3
        or not all(map(_AXIS.fullmatch, words))
        or len({word[-1] for word in words}) != 3
    ):
        raise ValueError(f"axes '{axes}'; expected x, y and z once each, signed, such as 'x,-y,-z'")
    matrix = np.zeros((3, 3))
    for row, word in enumerate(words):
        matrix[row, "xyz".index(word[-1])] = -1.0 if word[0] == "-" else 1.0
    return matrix


def turn_of(axes: str) -> np.ndarray:
    """Return the matrix of a signed permutation that is a rotation, shape (3, 3).

    Raises ValueError as :func:`matrix_of`, or for a mirror image.
    """
    matrix = matrix_of(axes)
    if is_mirror(axes):
        signs = [np.where(np.arange(3) == row, -1.0, 1.0)[:, None] * matrix for row in range(3)]
        hint = " ".join(
            next(
                name for name, exchange in zip(EXCHANGES, MATRICES) if np.array_equal(exchange, one)
            )
            for one in signs
        )
        raise ValueError(
            f"axes '{axes}' mirror the world: no rotation turns them into ours; flip one"
            f" sign: {hint}"
        )
    return matrix


def is_mirror(axes: str) -> bool:
    """Return whether a signed permutation is a mirror image."""
    return bool(np.linalg.det(matrix_of(axes)) < 0.0)


EXCHANGES = tuple(
    ",".join(sign + letter for sign, letter in zip(signs, order))
    for order in permutations("xyz")
    for signs in product(("", "-"), repeat=3)
)
"""All 48 signed permutations."""
TURNS = tuple(axes for axes in EXCHANGES if not is_mirror(axes))  # the 24 rotations
MATRICES = np.array([matrix_of(axes) for axes in EXCHANGES])
"""Matrix of each of :data:`EXCHANGES`, shape (48, 3, 3)."""
