"""The actor's observation, which the training environment and the HIL runner both compute here.

Onboard-safe.

A frame holds one control step's measurements in a row, to which training adds noise. ``observe``
pushes the payload's part into the history and assembles the actor's input. With E the batch size (1
on board), the layouts are

``state`` (35 with a history of 3; the paper, Sec. III-C), world frame, SI units::

    position 3 | velocity 3 | body rates 3 | rotation 6 | previous action 5
    | goal - payload, horizontal 2 | payload - vehicle, now and H steps back 3 (1 + H) | attached 1

``vision`` (61, or 69 with validity bits; Sec. IV-C)::

    position 3 | velocity 3 | body rates 3 | rotation 6 | previous action 5 | goal corners 8
    | payload keypoints, now and H steps back 8 (1 + H) | attached 1
    | validity of goal and payload keypoints 8

With ``located``, the positions of goal and payload 6 (``vision``) or the averaged goal 2
(``state``) follow. If goals move, the fitted velocity of the goal 2 follows in both layouts
(:mod:`visthrow.onboard.goal_motion`).

For a policy for many vehicles, ``response`` earlier steps follow, each velocity 3 | body rates 3 |
previous action 4, newest first, and then the vehicle's properties (:mod:`visthrow.task.fleet`).

The rotation is the first two columns of rot_wb (Zhou et al., CVPR 2019), column after column.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch

from camera.arrays import Array, library, push
from camera.keypoints import KEYPOINTS

VEHICLE = 15
"""Width of the vehicle's part."""

RESPONSE = 10
"""Width of one earlier step of a vehicle's response."""

SETUPS = {"none": 0, "given": 4, "exact": 24}
"""Value of ``setup`` -> width of the vehicle's properties."""

LOCATED = {"state": 2, "vision": 6}
"""Layout -> width of the positions of goal and payload (:mod:`visthrow.onboard.goal_motion`)."""


@dataclass(frozen=True)
class Layout:
    """Widths of one observation layout."""

    name: str
    goal: int  # width of the goal's part
    payload: int  # width of the payload's part in one step
    history: int  # H
    validity: int  # width of the validity bits
    motion: int  # width of the goal's velocity
    located: int = 0  # width of the positions of goal and payload
    response: int = 0  # number of earlier steps of the vehicle's response
    setup: int = 0  # width of the vehicle's properties

    @property
    def fits(self) -> bool:
        """Return whether the goal is fitted over the steps of a throw
        (:mod:`visthrow.onboard.goal_motion`).
        """
        return bool(self.motion or self.located)

    @property
    def frame(self) -> int:
        """Return the width of a frame, without the validity bits."""
        return VEHICLE + self.goal + self.payload

    @property
    def groups(self) -> dict[str, int]:
        """Return the widths of the parts of the actor's input, in their order."""
        return {
            "vehicle": VEHICLE,
            "previous action": 5,
            "goal": self.goal,
            "payload": self.payload * (1 + self.history),
            "attached": 1,
            "validity": self.validity,
            "located": self.located,
            "goal velocity": self.motion,
            "response": self.response * RESPONSE,
            "setup": self.setup,
        }

    @property
    def dimension(self) -> int:
        """Return the width of the actor's input."""
        return sum(self.groups.values())

    def columns(self, *names: str) -> list[int]:
        """Return the columns of these groups in the actor's input."""
        widths = list(self.groups.items())
        starts = [sum(width for _, width in widths[:k]) for k in range(len(widths))]
        places: list[int] = []
        for (name, width), start in zip(widths, starts):
            if name in names:
                places += range(start, start + width)
        return places


def layout_of(params: Any) -> Layout:
    """Return the layout of :class:`visthrow.task.ObservationParams` or an object with its fields.

    Raises ValueError: an unknown layout or a negative history.
    """
    if params.history < 0:
        raise ValueError(f"observation history {params.history}; expected 0 or more")
    # a contract may omit fields with default values
    motion = 2 if getattr(params, "goal_velocity", False) else 0
    response = getattr(params, "response", 0)
    setup = SETUPS[getattr(params, "setup", "none")]
    if getattr(params, "located", False):
        places = LOCATED.get(params.layout, 0)
    else:
        places = 0
    if params.layout == "state":
        return Layout("state", 2, 3, params.history, 0, motion, places, response, setup)
    if params.layout == "vision":
        bits = KEYPOINTS if params.validity else 0
        return Layout("vision", 8, 8, params.history, bits, motion, places, response, setup)
    raise ValueError(f"observation layout {params.layout!r}; expected 'state' or 'vision'")


def join_arrays(parts: list[Array]) -> Array:
    """Concatenate arrays along the last axis."""
    return library(parts[0]).concatenate(parts, -1)


def resample(history: Array, newest: Array, ages: list[float], period: float) -> Array:
    """Resample a history to a regular period by linear interpolation.

    Args:
        history: measurements of earlier steps, newest first, shape (E, 1 + H, layout.payload).
        newest: measurements of this step, shape (E, layout.payload).
        ages: ages of the earlier steps, newest first, ascending [s]; further rows of the history
            are copies of the oldest.
        period: control period [s].

    Returns:
        Rows with ages of 1, 2, ... periods, shape (E, 1 + H, layout.payload); rows older than all
        measurements equal the oldest one.
    """
    xp = library(history)
    knots = [0.0, *ages[: history.shape[1]]]
    rows = xp.concatenate([newest[:, None], history], 1)
    out = []
    for k in range(1, 1 + history.shape[1]):
        after = next((i for i, age in enumerate(knots) if age >= k * period), len(knots) - 1)
        gap = knots[after] - knots[after - 1]
        share = min((k * period - knots[after - 1]) / gap, 1.0)
        before = rows[:, after - 1]
        out.append((1.0 - share) * before + share * rows[:, after])
    return xp.stack(out, 1)


@lru_cache
@torch.inference_mode(False)
def _rotation_terms(xp: Any, device: Any, dtype: Any) -> tuple[Any, Any, Any]:
    """Return the indices of the products of quaternion entries that form each entry of the matrix,
    two each, their signs, and the identity to which they are added.
    """
    # indices into xx, xy, xz, xw, yx, ...
    one, two = ([5, 1, 2, 1, 0, 6, 2, 6, 0], [10, 11, 7, 11, 10, 3, 7, 3, 5])
    signs = [-1, 1, 1, 1, -1, 1, 1, 1, -1, -1, -1, 1, 1, -1, -1, -1, 1, -1]
    identity = xp.eye(3, device=device, dtype=dtype).flatten()
    chosen = xp.asarray([*one, *two], device=device)
    return chosen, xp.asarray(signs, device=device, dtype=dtype), identity


def rotation_from_quat(quat: Array) -> Array:
    """Return the rotation matrices, shape (E, 3, 3), of unit quaternions xyzw, shape (E, 4)."""
    chosen, signs, identity = _rotation_terms(library(quat), quat.device, quat.dtype)
    products = quat[..., None] * (quat + quat)[..., None, :]  # of all pairs
    terms = products.reshape(*quat.shape[:-1], 16)[..., chosen] * signs
    rot_wb = identity + (terms[..., :9] + terms[..., 9:])
    return rot_wb.reshape(*quat.shape[:-1], 3, 3)


def rotation_in(frame: Array) -> Array:
    """Return the measured attitudes rot_wb, shape (E, 3, 3), of frames, shape (E, F); with noise
    their columns are not exactly orthonormal.
    """
    x_axis = frame[:, 9:12]
    y_axis = frame[:, 12:15]
    xp = library(frame)
    return xp.stack([x_axis, y_axis, xp.linalg.cross(x_axis, y_axis)], -1)


def vehicle_part(pos_w: Array, vel_w: Array, rate_b: Array, rot_wb: Array) -> Array:
    """Return the vehicle's part of a frame, shape (E, 15)."""
    parts = [pos_w, vel_w, rate_b, rot_wb[..., 0], rot_wb[..., 1]]
    return join_arrays(parts)


def state_part(pos_w: Array, goal_w: Array, payload_w: Array) -> Array:
    """Return goal and payload of a state frame: horizontal offset goal - payload, and payload -
    vehicle, shape (E, 5).
    """
    return join_arrays([goal_w[:, :2] - payload_w[:, :2], payload_w - pos_w])


def answer(frame: Array, previous_action: Array) -> Array:
    """Return the vehicle's response in one step, shape (E, 10): velocity, body rates and previous
    action.
    """
    return join_arrays([frame[:, 3:9], previous_action[:, :4]])


def observe(
    layout: Layout,
    frame: Array,
    valid: Array | None,
    previous_action: Array,
    attached: Array,
    history: Array,
    fresh: Array,
    goal_vel_w: Array | None = None,
    places: Array | None = None,
    answers: Array | None = None,
    setup: Array | None = None,
) -> tuple[Array, Array]:
    """Assemble the actor's input and update the history.

    Arguments of parts that the layout does not have are None.

    Args:
        layout: layout of the policy.
        frame: vehicle, goal and payload, shape (E, layout.frame).
        valid: validity of the keypoints, shape (E, 8).
        previous_action: clipped, shape (E, 5).
        attached: 1 while the payload is attached to the vehicle, shape (E,), float.
        history: payload measurements up to the previous step, newest first, shape
            (E, 1 + H, layout.payload).
        fresh: whether an episode begins at this step, bool, shape (E,); its history is then filled
            with the current value.
        goal_vel_w: fit of the goal's horizontal velocity [m/s], shape (E, 2).
        places: positions of goal and payload, shape (E, layout.located).
        answers: responses of earlier steps by :func:`answer`, newest first, shape (E, R, 10).
        setup: properties of the vehicle, shape (E, layout.setup).

    Returns:
        Observation, shape (E, layout.dimension), and the new history.
    """
    goal_end = VEHICLE + layout.goal
    optional = {
        "validity": valid,
        "located": places,
        "motion": goal_vel_w,
        "response": answers,
        "setup": setup,
    }
    further = []
    for name, value in optional.items():
        if getattr(layout, name) and value is not None:
            further.append(value.reshape(len(frame), -1))
    history = push(history, frame[:, goal_end:], fresh)
    parts = [
        frame[:, :VEHICLE],
        previous_action,
        frame[:, VEHICLE:goal_end],
        history.reshape(len(frame), -1),
        attached[:, None],
    ]
    return join_arrays(parts + further), history
