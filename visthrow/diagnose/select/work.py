"""What a diagnosis leaves behind for gain, report, plan and blind."""

from dataclasses import dataclass

from visthrow.diagnose.select.point import Point, Problem


@dataclass(frozen=True)
class Work:
    """The search's problem, its first and its last state."""

    problem: Problem
    before: Point
    after: Point
    active: tuple[int, ...]
