"""Sections on the model-based baseline: its throws and their breakdown, and agility against
accuracy with the policies on it.
"""

from collections.abc import Sequence

import numpy as np

from visthrow.common import statistics as st
from visthrow.paper import measurements
from visthrow.paper.baseline import front, thrower
from visthrow.paper.baseline.front import FRONT_TARGET, FRONT_THROWS
from visthrow.paper.baseline.thrower import BOUNDS
from visthrow.paper.report.result_set import SHIPPED, ResultSet, landed
from visthrow.paper.report.throws import SHORT
from visthrow.task.measurement import TARGETS
from visthrow.throws.results import Result
from visthrow.view import figures, parts
from visthrow.view.parts import Grid, Picture, Section, Text
from visthrow.view.tables import PAPER, of_paper

DRAWS = 800  # bootstrap samples of a hypervolume

KINDS = (("both", BOUNDS[0]), ("both", BOUNDS[1]), ("delay", BOUNDS[0]))
PANELS = (
    (
        "own model\n(policies: training simulator)",
        thrower.IDEAL,
        (("none", BOUNDS[0]), ("none", BOUNDS[1])),
        "hybrid",
    ),
    ("training simulator", "hybrid", KINDS, "hybrid"),
    ("realistic reference plant", "reference-realistic", KINDS, "reference-realistic"),
)
"""Title, the baseline's plant, its (compensation, bounds), the plant of the policies on it; the
first is the paper's comparison.
"""


def _default(result: Result) -> bool:
    """Whether speed and weights are those of the throws by target."""
    unit = result.unit
    default = thrower.unit(unit["plant"], unit["compensation"], unit["target"], 1)
    return all(unit[name] == default[name] for name in ("speed", "w_t", "rho", "bounds"))


def baseline_section(thrown: ResultSet) -> Section:
    """Throws of the baseline by target, plant and compensation, broken down as in the paper."""
    rows = []
    missing = []
    for target in TARGETS:
        for plant in (thrower.IDEAL, "hybrid", "reference-realistic"):
            for compensation in ("none",) if plant == thrower.IDEAL else thrower.MADE_UP:
                best = _best(thrown, plant, target, compensation)
                if best:
                    rows.append(best)
                elif plant != "reference-realistic" or compensation != "none":
                    missing.append(f"{SHORT[plant]}, {thrower.MADE_UP[compensation]}, {target:g} m")
    lead = Text(
        "Trajectory optimisation and model-predictive control (TO+MPC), as the paper's: release"
        " height and speed from the learnt policy, a septic spline, a nonlinear MPC on a rigid"
        " pendulum. In its own model it is an idealised bound, without delay, noise, release lag or"
        " aerodynamics. On the plants it flies the same throws as the policies, with none, most or"
        " all of the known delays made up for."
    )
    tables = [by_target(rows), Text(_bar(thrown), "finding")] if rows else []
    return parts.section(
        "baseline",
        "The model-based baseline",
        lead,
        *tables,
        *_steps(),
        missing=missing,
        head="Not thrown",
    )


def _best(thrown: ResultSet, plant: str, target: float, compensation: str) -> Result | None:
    """Throws at the speed and with the weights of the throws by target, the most there are."""
    selected = [
        r for r in _of_baseline(thrown, plant, target, compensation=compensation) if _default(r)
    ]
    return max(selected, key=lambda r: r.unit["throws"], default=None)


def _of_baseline(
    thrown: ResultSet, plant: str, target: float = FRONT_TARGET, **conditions: str
) -> list[Result]:
    return thrown.matching(kind="baseline", plant=plant, target=target, **conditions)


def by_target(results: Sequence[Result]) -> Grid:
    """Table of throws by target and plant, the paper's beside those of the own model."""
    head = (
        "target [m]",
        "plant",
        "made up for",
        "throws",
        "landed",
        "landing error [m]",
        "duration [s]",
        "e_p [cm]",
        "e_v [cm/s]",
        "tracking [cm]",
        "the paper's own model: error [m], duration [s]",
    )
    note = (
        "e_p and e_v: payload's position and velocity at separation against the plan; tracking:"
        " root mean square distance from the planned path until the release."
    )
    return Grid("The baseline by target", head, tuple(map(_row, results)), note, heads=3)


def _row(result: Result) -> tuple[str, ...]:
    unit = result.unit
    ideal = unit["plant"] == thrower.IDEAL
    paper = of_paper("TO+MPC", unit["target"]) if ideal else "-"
    head = (
        f"{unit['target']:.1f}",
        SHORT[unit["plant"]],
        "-" if ideal else thrower.MADE_UP[unit["compensation"]],
        str(len(result.good)),
        landed(result, digits=0),
    )
    if not result.good.any():
        return (*head, "-", "-", "-", "-", "-", paper)
    means = (
        f"{100 * result.of(name).mean():.1f}"
        for name in ("position_error", "velocity_error", "tracking")
    )
    return (
        *head,
        st.mean(result.of("error")).text(),
        f"{result.of('duration').mean():.3f}",
        *means,
        paper,
    )


def _steps() -> list[Grid | Text]:
    """Step times of the controller, from the records of ``python -m bench.mpc``."""
    records = [measurements.load(path) for path in sorted(measurements.FOLDER.glob("mpc*.json"))]
    if not records:
        return [
            Text(
                "No step times of the controller: `python -m bench.mpc --record mpc-cpu`.",
                "missing",
            )
        ]
    grids = []
    for record in records:
        cpu = record["provenance"]["processors"]["cpu"]
        (table,) = record["tables"]
        note = f"{measurements.made_by(record)}. {record['notes'][0]}"
        rows = tuple(map(tuple, table["rows"]))
        grids.append(
            Grid(
                f"Step of the controller, one core of an {cpu}",
                tuple(table["header"]),
                rows,
                note,
                heads=2,
            )
        )
    return grids


def _bar(thrown: ResultSet) -> str:
    """Own-model errors and durations against the paper's: within 40 % of them, or better."""
    words = []
    for target in TARGETS:
        best = _best(thrown, thrower.IDEAL, target, "none")
        if best and best.good.any():
            error = best.of("error").mean()
            duration = best.of("duration").mean()
            paper = PAPER[("TO+MPC", target)]
            words.append(
                f"{target:g} m: error {error / paper[0]:.2f} and duration {duration / paper[2]:.2f}"
                " times the paper's"
            )
    return "In its own model: " + "; ".join(words) + "."


def _panel(
    heading: str, plant: str, kinds: Sequence, policies: Sequence[tuple], charts: Sequence[tuple]
) -> figures.Trade:
    """Return the panel of a plant: fronts of the baseline, policies, and the paper's points."""
    stars = [
        (f"{name} policy", st.mean(result.of("duration")), st.mean(result.of("error")))
        for name, result in policies
    ]
    crosses = _paper_points() if plant == thrower.IDEAL else ()
    late = {"delay": ", release lag not made up for"}
    fronts = tuple(
        (
            kinds.index((made_up, bounds)),
            f"TO+MPC, bounds on {bounds}{late.get(made_up, '')}",
            points_of(selected),
        )
        for (made_up, bounds), selected in charts
    )
    return figures.Trade(heading, fronts, tuple(stars), crosses)


def _front_table(sums: Sequence[tuple]) -> Grid:
    """Return the fronts in figures."""
    head = (
        "plant",
        "what",
        "settings",
        "all landed",
        "fastest [s]",
        "most accurate [m]",
        "hypervolume [s m]",
        "correlation of landing error with e_v",
    )
    time, error = front.CORNER
    note = (
        f"Hypervolume: area that is beaten up to {time:g} s and {error:g} m; more is better."
        " Correlations are over throws of all settings; the paper states that the error follows"
        " e_v."
    )
    return Grid("Fronts in figures", head, tuple(sums), note, heads=2)


def _panel_of(
    thrown: ResultSet, row: tuple, names: Sequence[str], sentences: list, sums: list, missing: list
) -> figures.Trade:
    """Return the panel of a row of :data:`PANELS`; add its sentences, its sums, what it lacks."""
    heading, plant, kinds, policies_on = row
    title = SHORT[plant]
    shipped = [(name, thrown.shipped(name, policies_on, FRONT_TARGET)) for name in names]
    policies = [(name, result) for name, result in shipped if result and result.good.any()]
    charts = []
    for compensation, bounds in kinds:
        selected = _swept(_of_baseline(thrown, plant, compensation=compensation, bounds=bounds))
        label = f"TO+MPC, bounds on {bounds}"
        if plant != thrower.IDEAL:
            label += f", {thrower.MADE_UP[compensation]}"
        if selected:
            charts.append(((compensation, bounds), selected))
            sums.append(_summed(title, label, selected))
            sentences += _verdicts(title, label, selected, policies, policies_on)
        elif (plant, bounds) != ("reference-realistic", BOUNDS[1]):
            missing.append(f"{title}, {label}")
    sums += [_policy_sum(title, name, result) for name, result in policies]
    return _panel(heading, plant, kinds, policies, charts)


def front_section(
    thrown: ResultSet, rows_of_panels: Sequence[tuple] = PANELS, names: Sequence[str] = SHIPPED
) -> Section:
    """Return the sweep on each plant, as in :data:`PANELS`, with the policies of these names on it,
    and who beats whom.
    """
    sentences: list = []
    sums: list = []
    missing: list = []
    picture = None
    table = None
    panels = [_panel_of(thrown, row, names, sentences, sums, missing) for row in rows_of_panels]
    lead = Text(
        f"Release speed, duration and energy weights are swept at {FRONT_TARGET:g} m. A setting"
        " counts where all its throws landed. Plans bound the payload's path alone, as the paper's"
        " do, or the vehicle's thrust and its turning as well. Lines join the settings that no"
        " other one of their kind beats; stars are the learnt policies with 95 % intervals."
    )
    if any(len(points) for panel in panels for _, _, points in panel.fronts):
        text = (
            "Agility against accuracy, nearer to the lower left corner is better. On the plants the"
            " baseline's known delays are made up for, except where the legend says otherwise."
            " Crosses and grey stars are the paper's."
        )
        picture = Picture("front", figures.trades(panels), text)
    if sums:
        table = _front_table(sums)
    caption = (
        lead,
        picture,
        table,
        *(Text(text, "finding") for text in sentences),
        _breakdown(thrown),
    )
    return parts.section(
        "front", "Agility against accuracy", *caption, missing=missing, head="Not swept"
    )


def _swept(selected: Sequence[Result]) -> list[Result]:
    """Throws of the sweep: those by target are more."""
    return [r for r in selected if r.unit["throws"] <= FRONT_THROWS or not _default(r)]


def points_of(selected: Sequence[Result]) -> np.ndarray:
    """Mean duration [s] and landing error [m] of settings whose throws all landed, shape (N, 2)."""
    return np.array(
        [(r.of("duration").mean(), r.of("error").mean()) for r in selected if r.good.all()]
    ).reshape(-1, 2)


def _paper_points() -> tuple[tuple[str, np.ndarray], ...]:
    swept = np.array([(row[4], row[3]) for row in front.PAPER_FRONT])
    real = np.array(
        [(PAPER[(name, FRONT_TARGET)][2], PAPER[(name, FRONT_TARGET)][0]) for name in SHIPPED]
    )
    return (
        ("the paper's TO+MPC, its own model", swept),
        ("the paper's policies, real vehicle", real),
    )


def hypervolume(selected: Sequence[Result]) -> st.Interval | None:
    """Hypervolume of the settings whose throws all landed, with its interval over throws; None
    without any.
    """
    sets = [np.column_stack([r.of("duration"), r.of("error")]) for r in selected if r.good.all()]
    if not sets:
        return None
    rng = np.random.default_rng(0)
    resampled = np.stack(
        [
            np.stack([s[rng.integers(len(s), size=len(s))].mean(0) for s in sets])
            for _ in range(DRAWS)
        ]
    )
    samples = np.array([front.hypervolume(points) for points in resampled])
    low, high = np.quantile(samples, (0.025, 0.975))
    return st.Interval(
        front.hypervolume(np.stack([s.mean(0) for s in sets])), float(low), float(high), "throws"
    )


def _summed(title: str, label: str, selected: Sequence[Result]) -> tuple[str, ...]:
    points = points_of(selected)
    volume = hypervolume(selected)
    if volume is None:
        return (title, label, str(len(selected)), "0", "-", "-", "-", "-")
    good = [r for r in selected if r.good.all()]
    error, velocity = (
        np.concatenate([r.of(name) for r in good]) for name in ("error", "velocity_error")
    )
    related = st.correlation(velocity, error).text(2) if len(error) > 2 else "-"
    return (
        title,
        label,
        str(len(selected)),
        str(len(good)),
        f"{points[:, 0].min():.3f}",
        f"{points[:, 1].min():.3f}",
        volume.text(3),
        related,
    )


def _policy_sum(title: str, name: str, result: Result) -> tuple[str, ...]:
    volume = hypervolume([result])
    text = "-" if volume is None else volume.text(3)
    return (
        title,
        f"learnt {name} policy, {SHORT[result.unit['plant']]}",
        "1",
        str(int(result.good.all())),
        f"{result.of('duration').mean():.3f}",
        f"{result.of('error').mean():.3f}",
        text,
        "-",
    )


def _verdicts(
    title: str,
    label: str,
    selected: Sequence[Result],
    policies: Sequence[tuple[str, Result]],
    policies_on: str,
) -> list[str]:
    """Whether the paper's claim holds: no setting as accurate and as fast, and at each setting's
    accuracy the policy faster.
    """
    points = points_of(selected)
    sentences = []
    for name, result in policies:
        point = np.array([result.of("duration").mean(), result.of("error").mean()])
        head = (
            f"**{title}**, {label} against the {name} policy on the {SHORT[policies_on]}"
            f" ({point[0]:.3f} s, {point[1]:.3f} m): "
        )
        if not len(points):
            sentences.append(head + f"none of {_count(selected)} landed all its throws.")
            continue
        beating = points[np.all(points <= point, axis=1)]
        faster = points[points[:, 0] < point[0]]
        nearer = points[points[:, 1] < point[1]]
        if len(beating):
            best = beating[np.argmin(beating[:, 0])]
            claim = f"{len(beating)} of {_count(points)} as accurate and as fast at once"
            claim += f", the fastest with {best[0]:.3f} s and {best[1]:.3f} m"
        else:
            claim = "no setting is both as accurate and as fast"
        if not len(faster):
            speed = "the policy is faster than every setting"
        else:
            speed = f"faster than the policy: {_count(faster)}"
        accuracy = f"more accurate: {len(nearer)} of {_count(points)}" + (
            f", the fastest of which takes {nearer[:, 0].min() / point[0]:.2f} times as long"
            if len(nearer)
            else ""
        )
        sentences.append(f"{head}{claim}; {speed}; {accuracy}.")
    return sentences


def _count(points: Sequence) -> str:
    return f"{len(points)} setting" + ("" if len(points) == 1 else "s")


def _breakdown(thrown: ResultSet) -> Grid | None:
    """Return the paper's table of settings, and ours of the own model."""
    selected = _swept(_of_baseline(thrown, thrower.IDEAL))
    if not selected:
        return None
    rows = [
        (
            f"{v:g}",
            f"{w_t / 1e3:g}k",
            f"{rho:g}",
            "the paper's",
            f"{e:.3f}",
            f"{d:.3f}",
            f"{100 * p:.1f}",
            f"{100 * u:.1f}",
        )
        for v, w_t, rho, e, d, p, u in front.PAPER_FRONT
    ]
    for r in sorted(selected, key=lambda r: (r.unit["bounds"], r.unit["speed"], -r.unit["w_t"])):
        unit = r.unit
        head = (
            f"{unit['speed']:g}",
            f"{unit['w_t'] / 1e3:g}k",
            f"{unit['rho']:g}",
            f"bounds on {unit['bounds']}",
        )
        if r.good.all():
            parts = (100 * r.of(name).mean() for name in ("position_error", "velocity_error"))
            rows.append(
                (
                    *head,
                    st.mean(r.of("error")).text(),
                    f"{r.of('duration').mean():.3f}",
                    *(f"{x:.1f}" for x in parts),
                )
            )
        else:
            rows.append((*head, f"landed {landed(r, digits=0)}", "-", "-", "-"))
    head = (
        "v [m/s]",
        "w_t",
        "rho",
        "plan",
        "landing error [m]",
        "duration [s]",
        "e_p [cm]",
        "e_v [cm/s]",
    )
    return Grid(
        "Breakdown of the front in the own model; the paper's are of ten throws each",
        head,
        tuple(rows),
        heads=0,
    )
