"""Section on the ablations: the effect of each component of the simulator on the throws on the
reference plants.
"""

import math
from itertools import product

from visthrow.common import statistics as st
from visthrow.paper.report import charts
from visthrow.paper.report.result_set import ANY, SHORT, WORDS, ResultSet, cells, errors
from visthrow.paper.results import Result
from visthrow.view import figures, parts
from visthrow.view.parts import Grid, Picture, Section, Text
from visthrow.view.tables import PAPER_ABLATIONS

TARGET = 2.0  # target of Table V [m]

TITLES: dict[str, str] = WORDS["ablations"]
"""Variant -> its name in tables."""

PAPER_FOUR = tuple(name for name in PAPER_ABLATIONS if name != "full")
FURTHER = tuple(name for name in TITLES if name not in PAPER_ABLATIONS)  # not in the paper
# numbers of throws of each ablation and of the full model (the paper's figure of landing points)
PAPER_THROWS = 5
PAPER_FULL_THROWS = 10

NOTE = (
    "Scatter: root mean square distance from the mean landing point of all trainings; the rest of"
    " the error is bias. We computed the paper's interval from its deviations and numbers of"
    " throws."
)

HEADER = (
    "configuration | trainings | throws | landed | landing error [m] | ratio to full"
    " | the paper's ratio | scatter [m] | duration [s] | bias along [m] | bias left [m] | lands"
    " | the paper: lands"
)

PLANTS = ("reference-realistic", "reference")
"""Plants for ablated policies, without retraining; the first is the stand-in for a vehicle."""

SHORT_LAYOUT = {"state": "state policies", "vision": "vision policies"}


def section(thrown: ResultSet) -> Section:
    """Return the section with the error ratios to the full model, the landing points, and a
    sentence on each component.
    """
    lead = Text(
        "Each policy was trained with one component of the simulator removed and otherwise in the"
        " same way, then flown without retraining on the full reference plants at 2.0 m. These have"
        " other code and noise but the same equations, so errors are smaller than in training. They"
        " are stand-ins for a vehicle, not vehicles. The ratio is its mean landing error over that"
        " of the full model. With several trainings (seeds), intervals draw first trainings and"
        " then throws within them. The paper's ratios come from five throws of a real vehicle for"
        " each variant."
    )
    grids = []
    marks = []
    missing = []
    sentences = []
    for series, (layout, plant) in enumerate(product(SHORT_LAYOUT, PLANTS)):
        full = thrown.seeds(layout, "full", plant, TARGET, {})
        if not full:
            missing.append(f"the full {layout} model's own trainings on the {SHORT[plant]}")
            continue
        rows = [_row("full", full) | {"ratio to full": "1", "the paper's ratio": "-"}]
        for variant in (*PAPER_FOUR, *FURTHER):
            trainings = thrown.seeds(layout, variant, plant, TARGET)
            if trainings:
                ratio = st.ratio(errors(trainings), errors(full))
                rows.append(_row(variant, trainings) | {"ratio to full": ratio.text(2)})
                paper = None if series else paper_ratio(variant)
                marks.append(charts.Mark(TITLES[variant], ratio, series, paper))
                if not series:
                    sentences.append(_sentence(variant, ratio, trainings))
            elif layout == "state" or variant in PAPER_FOUR:
                missing.append(f"{TITLES[variant]} ({layout}, {SHORT[plant]})")
        title = f"{SHORT_LAYOUT[layout].capitalize()} at {TARGET:.1f} m on the {SHORT[plant]}"
        grids.append(Grid.from_rows(title, HEADER, rows, NOTE))
    picture = None
    if marks:
        series = [f"{a},\n{SHORT[b]}" for a, b in product(SHORT_LAYOUT.values(), PLANTS)]
        chart = charts.marks(
            marks, "mean landing error over the full model's", series, zero=1.0, log=True
        )
        text = (
            "Error ratio to the full model with 95 % intervals; at 1 the component does not matter."
        )
        picture = Picture("ablations", chart, text)
    title = "What each component of the simulator is worth"
    findings = (Text(text, "finding") for text in sentences)
    return parts.section(
        "ablations", title, lead, picture, *grids, _scatter(thrown), *findings, missing=missing
    )


def paper_ratio(variant: str) -> st.Interval | None:
    """Return the paper's ratio with a normal interval from its standard deviations and numbers of
    throws; None for a variant that is not in the paper.
    """
    if variant not in PAPER_ABLATIONS:
        return None
    (mean, std) = PAPER_ABLATIONS[variant][:2]
    (full, full_std) = PAPER_ABLATIONS["full"][:2]
    ratio = mean / full
    half = (
        1.96
        * ratio
        * math.hypot(
            std / mean / math.sqrt(PAPER_THROWS), full_std / full / math.sqrt(PAPER_FULL_THROWS)
        )
    )
    return st.Interval(ratio, ratio - half, ratio + half)


def _row(variant: str, trainings: list[Result]) -> dict[str, str]:
    paper = paper_ratio(variant)
    bias = st.bias([r.miss for r in trainings])
    row = cells(*trainings) | {
        "configuration": TITLES[variant],
        "scatter [m]": f"{bias.scatter:.3f}",
        "bias along [m]": bias.along.text(sign=True),
        "bias left [m]": bias.lateral.text(sign=True),
        "lands": bias.direction,
    }
    if paper is not None:
        row["the paper's ratio"] = paper.text(1)
        row["the paper: lands"] = PAPER_ABLATIONS[variant][4]
    return row


def _sentence(variant: str, ratio: st.Interval, trainings: list[Result]) -> str:
    """Return sentences on whether the component matters, here and in the paper."""
    if 1.0 in ratio:
        verdict = "no effect shows"
    elif ratio.value > 1.0:
        verdict = "the component matters"
    else:
        verdict = "the policy is better without it"
    bias = st.bias([r.miss for r in trainings])
    text = f"**{TITLES[variant]}**: {ratio.text(2)} times the full model's error: {verdict}"
    signs = f" Bias here: {bias.direction}, {100 * bias.share:.0f} % of the mean square miss"
    paper = paper_ratio(variant)
    if paper is not None:
        distinct = paper.low > ratio.high or paper.high < ratio.low
        agree = "the intervals do not overlap" if distinct else "the intervals overlap"
        text += f"; the paper: {paper.text(2)}, {agree}"
        signs += f"; the paper's throws: {PAPER_ABLATIONS[variant][4]}"
    if len(trainings) == 1:
        signs += ". One training: the interval covers throws, not trainings"
    return f"{text}.{signs}."


def _scatter(thrown: ResultSet) -> Picture | None:
    plant = PLANTS[0]
    panels = []
    for variant in ("full", *PAPER_FOUR, *FURTHER):
        trainings = thrown.seeds("state", variant, plant, TARGET, {} if variant == "full" else ANY)
        if trainings:
            title = TITLES[variant]
            if variant in PAPER_ABLATIONS:
                title += f"\npaper: {PAPER_ABLATIONS[variant][4]}"
            series = [(f"training {r.unit['train_seed']}", r.miss) for r in trainings]
            panels.append((title, series))
    if len(panels) < 2:
        return None
    text = (
        f"Landing points of state policies on the {SHORT[plant]} at {TARGET:.1f} m, one colour for"
        " each training; large marks: means. Points above the target are too far."
    )
    return Picture("ablation_scatter", figures.scatter(panels, 4), text)
