"""Words of the picture of a throw."""

from types import SimpleNamespace

from visthrow.view import strip


def test_the_headline_names_the_policy_as_it_is_called():
    meta = {
        "policy": "vision",
        "goal_w": [2.0, 0.0, 0.0],
        "result": {"error": 0.021, "duration": 1.05},
    }
    said = strip._headline(SimpleNamespace(meta=meta))
    assert (
        said == "Policy vision, target 2.0 m: the ball lands 2.1 cm from it, 1.05 s after the start"
    )
