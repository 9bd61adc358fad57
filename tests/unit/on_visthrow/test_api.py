"""The commands from Python: the options of the command line as keywords."""

from pytest import raises

import visthrow
from visthrow.cli import api
from visthrow.common.errors import VisthrowError


def test_keywords_become_options():
    assert api._words("--seed", 3, False) == ["--seed", "3"]
    assert api._words("--targets", (1.5, 2.0), False) == ["--targets", "1.5", "2.0"]
    assert api._words("--set", {"rope.length": 0.4, "a": 1}, True) == [
        "--set",
        "rope.length=0.4",
        "--set",
        "a=1",
    ]
    assert api._words("--no-report", True, False) == ["--no-report"]
    assert api._words("--json", None, False) == []


def test_mistakes_raise():
    with raises(VisthrowError, match="not a valid command"):
        visthrow.compare("state", no_such_option=1)
    with raises(VisthrowError, match="no_such_policy"):
        visthrow.fly("no_such_policy")
    with raises(AttributeError, match="no attribute 'throw'"):
        _ = visthrow.throw
