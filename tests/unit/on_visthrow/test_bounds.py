"""Bounds that are declared with fields."""

import math
from dataclasses import dataclass
from typing import Annotated

from pytest import mark, raises

from visthrow.common.errors import ConfigError
from visthrow.config.bounds import Bound, Bounded, NotNegative, Positive


@dataclass(frozen=True)
class Few(Bounded):
    lag: NotNegative = 0.0
    share: Annotated[float, Bound(0.0, 1.0, "()")] = 0.5
    channel: Annotated[int, Bound(1, 12)] = 1
    rates: tuple[Positive, Positive] = (1.0, 1.0)
    hold: Annotated[float, Bound(0.0, 0.5, "(]")] | None = None
    name: str = ""


@dataclass(frozen=True)
class More(Few):
    weight: Positive = 1.0


@mark.parametrize(
    ("wrong", "message"),
    [
        ({"lag": -1e-9}, "lag is -1e-09; expected 0 or more"),
        ({"lag": math.nan}, "lag is nan; expected 0 or more"),
        ({"share": 0.0}, "share is 0.0; expected above 0 and below 1"),
        ({"share": 1.0}, "share is 1.0; expected above 0 and below 1"),
        ({"channel": 13}, "channel is 13; expected 1 to 12"),
        ({"rates": (1.0, 0.0)}, "rates is (1.0, 0.0); expected above 0"),
        ({"hold": 0.6}, "hold is 0.6; expected above 0 and at most 0.5"),
        ({"weight": 0.0}, "weight is 0.0; expected above 0"),
    ],
)
def test_what_lies_outside_is_named_with_its_bound(wrong, message):
    with raises(ConfigError) as caught:
        More(**wrong)
    assert str(caught.value) == message


def test_ends_that_belong_to_it_and_none_pass():
    assert More(lag=0.0, channel=12, hold=0.5).hold == 0.5
    assert More().hold is None
