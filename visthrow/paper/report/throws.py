"""Sections on the learnt policies: their throws on each plant, and vision compared with state."""

import math
from itertools import product

from visthrow.common import statistics as st
from visthrow.paper.baseline.front import FRONT_TARGET
from visthrow.paper.report import charts
from visthrow.paper.report.result_set import SHIPPED, SHORT, ResultSet, cells
from visthrow.paper.results import Result
from visthrow.task.measurement import TARGETS
from visthrow.throws.plants import PLANTS
from visthrow.view import figures
from visthrow.view.parts import Grid, Picture, Section, Text, section
from visthrow.view.tables import PAPER, PAPER_NOTE, format_paper_result

ERROR = "landing error [m], mean and 95 % interval"
VEHICLE = "the paper's vehicle: error [m], duration [s]"


def throws_section(thrown: ResultSet) -> Section:
    """Return the section with landing errors and durations of the shipped policies on each plant,
    and those of the paper.
    """
    rows = []
    missing = []
    for name, target, plant in product(SHIPPED, TARGETS, PLANTS):
        result = thrown.shipped_throws(name, plant, target)
        if result is not None:
            rows.append(_row(result))
        elif is_reported(plant, target):
            missing.append(f"{name} at {target:g} m on the {SHORT[plant]}")
    lead = Text(
        "Throws of the shipped policies from hover. In training, goals were within 2 m (`state`)"
        " and 2.5 m (`vision`); for the first 2.5 m is out of distribution. The training simulator"
        " has all noise of the training; the reference plants were not used in it."
    )
    header = (
        f"policy | target [m] | plant | throws | landed | {ERROR} | deviation [m] | duration [s]"
        f" | bias along / left [m] | {VEHICLE}"
    )
    table = Grid.from_rows("Landing error and duration", header, rows, PAPER_NOTE, heads=3)
    return section(
        "throws",
        "What the policies do",
        lead,
        table,
        _scatter(thrown),
        missing=missing,
        head="Not thrown",
    )


def is_reported(plant: str, target: float) -> bool:
    """Return whether the report includes this plant and target; the plain reference plant is
    included at only one target.
    """
    return plant != "reference" or target == FRONT_TARGET


def _row(result: Result) -> dict[str, str]:
    row = cells(result)
    row[VEHICLE] = format_paper_result(result.unit["policy"], result.unit["target"])
    if result.good.any():
        bias = st.bias(result.miss)
        row[ERROR] = row["landing error [m]"]
        row["deviation [m]"] = f"{result.of('error').std():.3f}"
        offset = f"{bias.along.value:+.3f} / {bias.lateral.value:+.3f}"
        row["bias along / left [m]"] = offset
    return row


def _scatter(thrown: ResultSet) -> Picture | None:
    for plant in ("reference-realistic", "hybrid"):
        panels = []
        for target in TARGETS:
            sets = [(name, thrown.shipped_throws(name, plant, target)) for name in SHIPPED]
            series = [
                (f"{name} policy", result.miss)
                for name, result in sets
                if result is not None and result.good.any()
            ]
            if series:
                panels.append((f"target {target:.1f} m", series))
        if panels:
            text = (
                f"Landing points from above on the {SHORT[plant]}; large marks: means. The paper's"
                " figure shows 1.5 m and 2.0 m."
            )
            return Picture("landings", figures.scatter(panels), text)
    return None


def vision_section(thrown: ResultSet) -> Section:
    """Return the section with the mean landing error of vision minus that of state, at each target
    on each plant.
    """
    rows = []
    marks = []
    missing = []
    for (i, plant), target in product(enumerate(PLANTS), TARGETS):
        pair = _groups(thrown, plant, target)
        if pair is None:
            if is_reported(plant, target):
                missing.append(f"{target:g} m on the {SHORT[plant]}")
            continue
        vision, state, runs = pair
        gap, faster = (_minus(vision, state, name) for name in ("error", "duration"))
        paper = _paper(target)
        comparison = "-" if paper is None else f"{paper[0].value:+.3f}, {paper[1]:+.3f}"
        figures_of_pair = (gap.text(sign=True), _sentence(gap), faster.text(sign=True), comparison)
        rows.append((SHORT[plant], f"{target:.1f}", runs, *figures_of_pair))
        reference = None if paper is None or i else paper[0]
        marks.append(charts.Mark(f"{target:.1f} m", gap, i, reference))
    parts = [
        Text(
            "Vision minus state: a positive value means that vision has a larger error. If several"
            " trainings of both are recorded, the interval covers trainings and throws. Otherwise"
            " it refers to pairs of throws of the two shipped policies, with the same vehicles,"
            " starts and winds."
        )
    ]
    if rows:
        header = (
            "plant | target [m] | policies | error: vision - state [m] | in words"
            " | duration: vision - state [s] | the paper's: error [m], duration [s]"
        )
        axis = "landing error, vision minus state [m]"
        picture = charts.marks(marks, axis, [SHORT[plant] for plant in PLANTS], zero=0.0)
        text = "Difference of mean landing errors with 95 % intervals; left: vision is better."
        parts += [
            Grid.from_rows("Vision against state", header, rows),
            Picture("vision", picture, text),
        ]
    return section(
        "vision", "Vision against state", *parts, missing=missing, head="Not thrown by both"
    )


def _minus(vision: list[Result], state: list[Result], name: str) -> st.Interval:
    """Return the difference of means, over pairs of throws if there is one policy of each layout
    and both flew the same vehicles and initial states.
    """
    alike = all(
        vision[0].unit[key] == state[0].unit[key] for key in ("throws", "seed", "plant", "target")
    )
    if len(vision) == len(state) == 1 and alike:
        return st.compare_pairs(vision[0].columns[name], state[0].columns[name])
    return st.difference([r.of(name) for r in vision], [r.of(name) for r in state])


def _groups(
    thrown: ResultSet, plant: str, target: float
) -> tuple[list[Result], list[Result], str] | None:
    """Return the runs of both layouts: those trained for the comparison if there are at least two
    of each, otherwise the shipped ones.
    """
    vision, state = (thrown.seeds(name, "full", plant, target, {}) for name in SHIPPED[::-1])
    if min(len(vision), len(state)) >= 2:
        return vision, state, f"{len(vision)} and {len(state)} trainings"
    shipped = [thrown.shipped_throws(name, plant, target) for name in SHIPPED[::-1]]
    if any(result is None or not result.good.any() for result in shipped):
        return None
    return shipped[:1], shipped[1:], "shipped"


def _paper(target: float) -> tuple[st.Interval, float] | None:
    """Return the paper's difference of errors [m], with a normal interval from its standard
    deviations over ten throws each, and that of durations [s].
    """
    vision = PAPER.get(("vision", target))
    state = PAPER.get(("state", target))
    if vision is None or state is None:
        return None
    gap = vision[0] - state[0]
    half = 1.96 * math.hypot(vision[1], state[1]) / math.sqrt(10.0)
    return st.Interval(gap, gap - half, gap + half), vision[2] - state[2]


def _sentence(gap: st.Interval) -> str:
    if 0.0 in gap:
        return "no difference shows"
    return "vision is worse" if gap.value > 0.0 else "vision is better"
