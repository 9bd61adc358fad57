"""Commands that got lost: what each would have changed, and that they are found and told beside
what else there is.
"""

from functools import cache

from tests.flown import fly, setting_with
from tests.plants import paper_plant
from visthrow.diagnose.select import lost_commands as dropped
from visthrow.diagnose.select import search
from visthrow.diagnose.throw.throw_model import ThrowModel

SHARE = 0.12
ONLY = ("cmd_delay", "com_x", "rate_gain", "wind_x", "payload_drag")


@cache
def model_of(lost: float, throws: int = 2, **theta: float) -> ThrowModel:
    return ThrowModel(
        fly(setting_with(theta), seed=4, free=1, throws=throws, seconds=3.0, lost=lost),
        paper_plant(),
        only=ONLY,
    )


def told(diagnosis):
    return [s for s in diagnosis.scatter if s.found]


def test_lost_commands_are_found_beside_a_cause():
    diagnosis = search.explain(model_of(SHARE, com_x=0.003))
    assert (diagnosis.overall, diagnosis.named, [s.name for s in told(diagnosis)]) == (
        "KNOWN",
        ("com_x",),
        [dropped.NAME],
    )
    assert abs(diagnosis.theta["com_x"] - 0.003) < 3e-4
    found = told(diagnosis)[0]
    assert found.low < SHARE < found.high
    assert found.nats > 50.0
