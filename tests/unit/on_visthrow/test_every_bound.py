"""Every number of every configuration: NaN, infinity and what lies outside its bound is refused."""

import dataclasses
import math
import typing
from dataclasses import replace
from functools import cache

from pytest import mark

from camera import field_bounds
from visthrow import config
from visthrow.common.errors import VisthrowError
from visthrow.config import kinds, schema


def hold_float(hint: typing.Any) -> bool:
    return hint is float or any(hold_float(part) for part in typing.get_args(hint))


def tables(value: typing.Any):
    """Yield the dataclasses within a loaded configuration."""
    if dataclasses.is_dataclass(value):
        yield value
        value = [getattr(value, name) for name in schema.hints(type(value))]
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from tables(item)


@cache
def examples() -> dict[type, typing.Any]:
    """Return one instance of each dataclass that a shipped configuration fills."""
    instances = {}
    for path in sorted(config.configs_root().rglob("*.toml")):
        loaded = config.load(kinds.schema_of(path.parent.name, path.stem), path)
        instances |= {type(table): table for table in tables(loaded)}
    return instances


def numbers() -> list:
    return [
        (table, name)
        for table in examples().values()
        for name, hint in schema.hints(type(table)).items()
        if hold_float(hint) and getattr(table, name) not in (None, (), {})
    ]


def put(value: typing.Any, number: float) -> typing.Any:
    """Replace the first number of a value."""
    if isinstance(value, dict):
        first = next(iter(value))
        return value | {first: put(value[first], number)}
    return (put(value[0], number), *value[1:]) if isinstance(value, tuple) else number


def test_the_configurations_hold_hundreds_of_numbers():
    assert len(numbers()) > 300


@mark.parametrize("wrong", [math.nan, math.inf, -math.inf, -1.0, 0.0])
def test_a_number_outside_its_bound_is_refused(wrong):
    accepted = []
    for table, name in numbers():
        bound = field_bounds._bounds(type(table)).get(name, field_bounds.Bound())
        if bound.holds(wrong):
            continue
        try:
            replace(table, **{name: put(getattr(table, name), wrong)})
            message = "accepted"
        except (VisthrowError, ValueError) as error:
            message = str(error)
        if "expected" not in message:
            accepted.append(f"{type(table).__name__}.{name}: {message}")
    assert accepted == []
