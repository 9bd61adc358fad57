"""The signs of body rates by poses or by reported rates alone: verdicts of the first hover on
vehicles that respond fast or slowly, and drift meanwhile.
"""

from types import SimpleNamespace

import numpy as np
from pytest import mark

from hil.control.response import ANGLE_NOISE, Response

PERIOD, MASS, PROBE = 0.02, 0.272, 0.3
DRIFT = 0.05  # deviation of a steady uncommanded turn [rad/s]
FLIGHTS = 10


def verdict(sign: float, lag: float, delay: int, reported: bool, rng: np.random.Generator) -> str:
    """Hover until a verdict; ``lag`` [s] and ``delay`` [ticks] of a vehicle's rates, which have a
    sign, 0 for none. Where they are reported, its poses do not turn: only the reports show them.
    """
    response = Response(PERIOD, MASS, 0.3, PROBE)
    commands = [(0.0, 0.0, 0.0)] * (delay + 1)
    angle, rate, drift = np.zeros(3), np.zeros(3), DRIFT * rng.standard_normal(3)
    while response.running:
        measured = (1.0 - reported) * (angle + ANGLE_NOISE * rng.standard_normal(3))
        quat = np.array([*(0.5 * measured), 1.0])
        pose = SimpleNamespace(quat=tuple(quat / np.linalg.norm(quat)), pos=(0.0, 0.0, 1.0))
        commands.append(response.rates())
        response.note((MASS * 9.81, *commands[-1]), pose, tuple(rate) if reported else None)
        rate = rate + (1.0 - np.exp(-PERIOD / lag)) * (sign * np.array(commands[-1 - delay]) - rate)
        angle = angle + PERIOD * (rate + drift)
    return response.problem or "turns as commanded"


BY_POSES = [(0.01, 0, False), (0.03, 1, False), (0.1, 2, False), (0.3, 2, False)]
REPORTED = [(0.01, 0, True), (0.03, 1, True)]


@mark.parametrize(("lag", "delay", "reported"), [*BY_POSES, *REPORTED])
@mark.parametrize(
    ("sign", "words"), [(1.0, "turns as"), (-1.0, "a sign is wrong"), (0.0, "not turn")]
)
def test_the_sign_of_a_rate_whatever_its_lag(sign, words, lag, delay, reported):
    rng = np.random.default_rng(5)
    verdicts = [verdict(sign, lag, delay, reported, rng) for _ in range(FLIGHTS)]
    assert all(words in text for text in verdicts), verdicts
