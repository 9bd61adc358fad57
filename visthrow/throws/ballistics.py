"""The payload alone in flight, in plain NumPy: where the simulator has left it, some time later."""

import numpy as np

from sim.params import GRAVITY, AirParams, RopeParams

STEP = 0.02  # largest of RK4 [s]; 1e-8 m off a tennis ball's path after a second


def flown(rope: RopeParams, air: AirParams, pos_w: np.ndarray, vel_w: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position [m] and velocity [m/s] of payloads, shape (E, 3), after flights [s], shape (E,), under gravity, wind, air forces."""
    time = np.asarray(time, dtype=float)[:, None]
    if not (rope.payload_drag or rope.payload_side or rope.payload_lift):
        fall = np.array([0.0, 0.0, -GRAVITY])
        return pos_w + time * vel_w + 0.5 * time**2 * fall, vel_w + time * fall
    wind = np.array(air.wind_w)
    share, side, lift = (x / rope.payload_mass for x in (rope.payload_drag, rope.payload_side, rope.payload_lift))

    def acceleration(v: np.ndarray) -> np.ndarray:
        through = v - wind
        across = np.cross([0.0, 0.0, 1.0], through)
        size = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        turned = side * across + lift * np.cross(through, across / size)
        return np.linalg.norm(through, axis=1, keepdims=True) * (turned - share * through) - [0.0, 0.0, GRAVITY]

    count = max(int(np.ceil(np.max(time, initial=0.0) / STEP)), 1)
    h, x, v = time / count, pos_w, vel_w
    for _ in range(count):
        a = acceleration(v)
        b = acceleration(v + 0.5 * h * a)
        c = acceleration(v + 0.5 * h * b)
        d = acceleration(v + h * c)
        x = x + h * v + h**2 / 6.0 * (a + b + c)
        v = v + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return x, v
