"""Section on the ablations: what each component of the simulator is worth on the
reference plants.
"""

import math

from visthrow.common import statistics as st
from visthrow.paper.report.result_set import ANY, ResultSet, errors, landed
from visthrow.paper.report.throws import SHORT
from visthrow.throws.results import Result
from visthrow.view import figures, parts
from visthrow.view.parts import Grid, Picture, Section, Text
from visthrow.view.tables import PAPER_ABLATIONS

TARGET = 2.0  # target of Table V [m]

PAPER_FOUR = tuple(name for name in PAPER_ABLATIONS if name != "full")
# number of throws of each ablation and of the full model (the paper's figure of landing points)
PAPER_THROWS = 5
PAPER_FULL_THROWS = 10

NOTE = (
    "Scatter: root mean square distance from the mean landing point of all trainings; what is left"
    " of the error is bias. The paper's interval is ours, from its deviations and numbers of"
    " throws."
)

FURTHER = ("no_delay", "no_battery", "no_release_lag")  # what the paper leaves out

TITLES = {
    "full": "full model",
    "no_aerodynamics": "no aerodynamics",
    "no_motor_lag": "no motor lag",
    "simple_controller": "simple rate controller",
    "rigid_cable": "rigid cable",
    "no_delay": "no command delay",
    "no_battery": "no battery",
    "no_release_lag": "no release lag",
}
"""Variant -> its name in tables."""

PLANTS = ("reference-realistic", "reference")
"""Where ablated policies fly without retraining; the first is the stand-in for a vehicle."""

SHORT_LAYOUT = {"state": "state policies", "vision": "vision policies"}


def section(thrown: ResultSet) -> Section:
    """Ratio to the full model with its interval, where the throws land, and what that says of each
    component.
    """
    lead = Text(
        "Each policy was trained with one component of the simulator removed and otherwise the same"
        " recipe, then flown without retraining on the full reference plants at 2.0 m: other code"
        " and noise, the same equations, so that policies land nearer there than in training. They"
        " stand in for a vehicle and are none. The ratio is its mean landing error over that of the"
        " full model trained alike; intervals draw trainings first and throws within them where"
        " there are several trainings (seeds). The paper's ratios come from five throws a variant"
        " of a real vehicle."
    )
    grids = []
    picture = None
    marks = []
    missing = []
    sentences = []
    for layout in ("state", "vision"):
        for plant in PLANTS:
            rows = _rows(thrown, layout, plant, marks, missing, sentences)
            if rows:
                head = (
                    "configuration",
                    "trainings",
                    "throws",
                    "landed",
                    "landing error [m]",
                    "ratio to full",
                    "the paper's ratio",
                    "scatter [m]",
                    "duration [s]",
                    "bias along [m]",
                    "bias left [m]",
                    "lands",
                    "the paper: lands",
                )
                title = (
                    f"{SHORT_LAYOUT[layout].capitalize()} at {TARGET:.1f} m on the {SHORT[plant]}"
                )
                grids.append(Grid(title, head, tuple(rows), NOTE))
    if marks:
        series = [
            f"{SHORT_LAYOUT[layout]},\n{SHORT[plant]}"
            for layout in SHORT_LAYOUT
            for plant in PLANTS
        ]
        chart = figures.marks(
            marks, "mean landing error over the full model's", series, zero=1.0, log=True
        )
        text = (
            "Error ratio to the full model with 95 % intervals; at 1 the component does not matter."
        )
        picture = Picture("ablations", chart, text)
    findings = (Text(text, "finding") for text in sentences)
    title = "What each component of the simulator is worth"
    return parts.section(
        "ablations", title, lead, picture, *grids, _scatter(thrown), *findings, missing=missing
    )


def _rows(
    thrown: ResultSet, layout: str, plant: str, marks: list, missing: list, sentences: list
) -> list[tuple[str, ...]]:
    full = thrown.seeds(layout, "full", plant, TARGET, {})
    if not full:
        missing.append(f"the full {layout} model's own trainings on the {SHORT[plant]}")
        return []
    rows = [_row("full", full, full)]
    for variant in (*PAPER_FOUR, *FURTHER):
        trainings = thrown.seeds(layout, variant, plant, TARGET)
        if not trainings:
            if layout == "state" or variant in PAPER_FOUR:
                missing.append(f"{TITLES[variant]} ({layout}, {SHORT[plant]})")
            continue
        rows.append(_row(variant, trainings, full))
        ratio = st.ratio(errors(trainings), errors(full))
        series = list(SHORT_LAYOUT).index(layout) * len(PLANTS) + PLANTS.index(plant)
        paper = paper_ratio(variant) if not series else None
        marks.append(figures.Mark(TITLES[variant], ratio, series, paper))
        if layout == "state" and plant == PLANTS[0]:
            sentences.append(_sentence(variant, ratio, trainings))
    return rows


def paper_ratio(variant: str) -> st.Interval | None:
    """Return the paper's ratio with a normal interval from its deviations and numbers of throws;
    None for what it leaves out.
    """
    if variant not in PAPER_ABLATIONS:
        return None
    (mean, std) = PAPER_ABLATIONS[variant][:2]
    (full, full_std) = PAPER_ABLATIONS["full"][:2]
    relative = math.hypot(
        std / mean / math.sqrt(PAPER_THROWS), full_std / full / math.sqrt(PAPER_FULL_THROWS)
    )
    ratio = mean / full
    half = 1.96 * relative * mean / full
    return st.Interval(ratio, ratio - half, ratio + half, "throws")


def _row(variant: str, trainings: list[Result], full: list[Result]) -> tuple[str, ...]:
    paper = paper_ratio(variant)
    bias = st.bias([r.miss for r in trainings])
    ratio = "1" if variant == "full" else st.ratio(errors(trainings), errors(full)).text(2)
    axial, lateral = (part.text(sign=True) for part in (bias.along, bias.lateral))
    return (
        TITLES[variant],
        str(len(trainings)),
        str(sum(len(r.good) for r in trainings)),
        landed(*trainings),
        st.mean(errors(trainings)).text(),
        ratio,
        "-" if paper is None or variant == "full" else paper.text(1),
        f"{bias.scatter:.3f}",
        f"{st.mean([r.of('duration') for r in trainings]).value:.3f}",
        axial,
        lateral,
        bias.direction,
        PAPER_ABLATIONS[variant][4] if variant in PAPER_ABLATIONS else "-",
    )


def _sentence(variant: str, ratio: st.Interval, trainings: list[Result]) -> str:
    """One sentence: whether the component matters here as the paper says."""
    paper = paper_ratio(variant)
    head = f"**{TITLES[variant]}**: {ratio.text(2)} times the full model's error"
    if 1.0 in ratio:
        verdict = "no effect shows"
    else:
        if ratio.value > 1.0:
            verdict = "the component matters"
        else:
            verdict = "leaving it out did not harm, it helped"
    distinct = paper is not None and (paper.low > ratio.high or paper.high < ratio.low)
    agree = "apart from ours" if distinct else "the intervals overlap"
    comparison = "" if paper is None else f"; the paper: {paper.text(2)}, {agree}"
    words = PAPER_ABLATIONS[variant][4] if variant in PAPER_ABLATIONS else ""
    bias = st.bias([r.miss for r in trainings])
    signs = f" Bias here: {bias.direction}, {100 * bias.share:.0f} % of the mean square miss"
    signs += f"; the paper's throws: {words}." if words else "."
    if len(trainings) > 1:
        seeds = ""
    else:
        seeds = " One training: the interval covers throws, not trainings."
    return f"{head}: {verdict}{comparison}.{signs}{seeds}"


def _scatter(thrown: ResultSet) -> Picture | None:
    plant = PLANTS[0]
    panels = []
    for variant in ("full", *PAPER_FOUR, *FURTHER):
        trainings = thrown.seeds("state", variant, plant, TARGET, {} if variant == "full" else ANY)
        if trainings:
            words = PAPER_ABLATIONS.get(variant)
            title = TITLES[variant] + ("" if words is None else f"\npaper: {words[4]}")
            panels.append(
                (title, [(f"training {r.unit['train_seed']}", r.miss) for r in trainings])
            )
    if len(panels) < 2:
        return None
    text = (
        f"Landing points of state policies on the {SHORT[plant]} at {TARGET:.1f} m, a colour a"
        " training; large marks: means. Above the target is too far."
    )
    return Picture("ablation_scatter", figures.scatter(panels, 4), text)
