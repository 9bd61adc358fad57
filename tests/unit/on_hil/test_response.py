"""The signs of body rates by poses or by reported rates alone: what the first hover says of
vehicles that answer fast or slowly, and drift meanwhile.
"""

from types import SimpleNamespace

import numpy as np
from pytest import mark

from hil.control.response import ANGLE_NOISE, Response

PERIOD, MASS, PROBE = 0.02, 0.272, 0.3
DRIFT = 0.05  # deviation of a steady turn that nobody commanded [rad/s]
FLIGHTS = 10


def verdict(sign: float, lag: float, delay: int, rng: np.random.Generator) -> str:
    """Hover until a verdict; ``lag`` [s] and ``delay`` [ticks] of a vehicle's rates, which have a
    sign, 0 for none.
    """
    response = Response(PERIOD, MASS, 0.3, PROBE)
    commands = [(0.0, 0.0, 0.0)] * (delay + 1)
    angle, rate, drift = np.zeros(3), np.zeros(3), DRIFT * rng.standard_normal(3)
    while response.running:
        measured = angle + ANGLE_NOISE * rng.standard_normal(3)
        quat = np.array([*(0.5 * measured), 1.0])
        pose = SimpleNamespace(quat=tuple(quat / np.linalg.norm(quat)), pos=(0.0, 0.0, 1.0))
        commands.append(response.rates())
        response.note((MASS * 9.81, *commands[-1]), pose)
        rate = rate + (1.0 - np.exp(-PERIOD / lag)) * (sign * np.array(commands[-1 - delay]) - rate)
        angle = angle + PERIOD * (rate + drift)
    return response.problem or "turns as commanded"


@mark.parametrize(("lag", "delay"), [(0.01, 0), (0.03, 1), (0.1, 2), (0.3, 2)])
@mark.parametrize(
    ("sign", "words"), [(1.0, "turns as"), (-1.0, "a sign is wrong"), (0.0, "not turn")]
)
def test_the_sign_of_a_rate_whatever_its_lag(sign, words, lag, delay):
    rng = np.random.default_rng(5)
    verdicts = [verdict(sign, lag, delay, rng) for _ in range(FLIGHTS)]
    assert all(words in text for text in verdicts), verdicts


@mark.parametrize(("lag", "delay"), [(0.01, 0), (0.03, 1)])
@mark.parametrize(("sign", "words"), [(1.0, "turns as"), (-1.0, "a sign is wrong")])
def test_the_sign_of_reported_rates(sign, words, lag, delay):
    """Of a vehicle whose poses do not turn: nothing else can tell."""
    response = Response(PERIOD, MASS, 0.3, PROBE)
    pose = SimpleNamespace(quat=(0.0, 0.0, 0.0, 1.0), pos=(0.0, 0.0, 1.0))
    commands = [(0.0, 0.0, 0.0)] * (delay + 1)
    rate = np.zeros(3)
    while response.running:
        commands.append(response.rates())
        response.note((MASS * 9.81, *commands[-1]), pose, tuple(rate))
        rate = rate + (1.0 - np.exp(-PERIOD / lag)) * (sign * np.array(commands[-1 - delay]) - rate)
    assert words in (response.problem or "turns as commanded")
