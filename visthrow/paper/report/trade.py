"""Sections on the model-based baseline: its throws and their breakdown, and its agility and
accuracy compared with the policies'.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common import statistics as st
from visthrow.paper import measurements
from visthrow.paper.baseline import front, thrower
from visthrow.paper.baseline.front import FRONT_TARGET, FRONT_THROWS
from visthrow.paper.baseline.thrower import BOUNDS
from visthrow.paper.report import charts
from visthrow.paper.report.result_set import (
    SHIPPED,
    SHORT,
    WORDS,
    ResultSet,
    cells,
    format_landed_share,
)
from visthrow.paper.results import Result
from visthrow.task.measurement import TARGETS
from visthrow.view import parts
from visthrow.view.parts import Grid, Picture, Section, Text
from visthrow.view.tables import PAPER, PAPER_FRONT, format_paper_result

DRAWS = 800  # bootstrap samples of a hypervolume

PANELS: list[dict[str, Any]] = WORDS["panels"]
"""Panels of the front: heading, the baseline's plant, its (compensation, bounds), the policies'
plant; the first panel is the paper's comparison.
"""


def _has_defaults(result: Result) -> bool:
    """Return whether speed, weights and bounds are those of the throws by target."""
    unit = result.unit
    default = thrower.unit(unit["plant"], unit["compensation"], unit["target"], 1)
    return all(unit[name] == default[name] for name in ("speed", "w_t", "rho", "bounds"))


MODEL = "the paper's own model: error [m], duration [s]"


def baseline_section(thrown: ResultSet) -> Section:
    """Return the section with the baseline's throws by target, plant and compensation, broken down
    as in the paper.
    """
    rows = []
    missing = []
    for target in TARGETS:
        for plant, compensation in thrower.rows(("hybrid", "reference-realistic")):
            best = _best(thrown, plant, target, compensation)
            if best:
                rows.append(best)
            elif plant != "reference-realistic" or compensation != "none":
                missing.append(
                    f"{SHORT[plant]}, {thrower.COMPENSATIONS[compensation]}, {target:g} m"
                )
    lead = Text(
        "Trajectory optimisation and model-predictive control (TO+MPC), as the paper's: release"
        " height and speed from the learnt policy, a septic spline, a nonlinear MPC on a rigid"
        " pendulum. In its own model it is an idealised bound, without delay, noise, release lag or"
        " aerodynamics. On the plants it flies the same throws as the policies, with none, most or"
        " all of the known delays compensated."
    )
    tables = [target_table(rows), Text(_bar(thrown), "finding")] if rows else []
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
    """Return the largest result with default speed and weights; None without any."""
    selected = [
        r
        for r in _find_baseline(thrown, plant, target, compensation=compensation)
        if _has_defaults(r)
    ]
    return max(selected, key=lambda r: r.unit["throws"], default=None)


def _find_baseline(
    thrown: ResultSet, plant: str, target: float = FRONT_TARGET, **conditions: str
) -> list[Result]:
    return thrown.find_results(kind="baseline", plant=plant, target=target, **conditions)


def target_table(results: Sequence[Result]) -> Grid | None:
    """Return the table of throws by target and plant, with the paper's for the controller's
    model.
    """
    header = (
        "target [m] | plant | compensation | throws | landed | landing error [m] | duration [s]"
        f" | e_p [cm] | e_v [cm/s] | tracking [cm] | {MODEL}"
    )
    note = (
        "e_p and e_v: payload's position and velocity at separation against the plan; tracking:"
        " root mean square distance from the planned path until the release."
    )
    return Grid.from_rows("The baseline by target", header, map(_row, results), note, heads=3)


PARTS = {
    "position_error": "e_p [cm]",
    "velocity_error": "e_v [cm/s]",
    "tracking": "tracking [cm]",
}
"""Column of a baseline's throws -> its heading."""


def _row(result: Result) -> dict[str, str]:
    unit = result.unit
    row = cells(result) | {"landed": format_landed_share(result, digits=0)}
    if unit["plant"] == thrower.IDEAL:
        row[MODEL] = format_paper_result("TO+MPC", unit["target"])
    else:
        row["compensation"] = thrower.COMPENSATIONS[unit["compensation"]]
    if result.good.any():
        row |= {head: f"{100 * result.of(name).mean():.1f}" for name, head in PARTS.items()}
    return row


def _steps() -> Iterator[Grid | Text | None]:
    """Yield computation times of the controller's step, from records of ``python -m bench.mpc``."""
    records = [measurements.load(path) for path in sorted(measurements.FOLDER.glob("mpc*.json"))]
    if not records:
        command = "`python -m bench.mpc --record mpc-cpu`"
        yield Text(f"No step times of the controller: {command}.", "missing")
    for record in records:
        cpu = record["provenance"]["processors"]["cpu"]
        (table,) = record["tables"]
        title = f"Step of the controller, one core of an {cpu}"
        note = f"{measurements.provenance_of(record)}. {record['notes'][0]}"
        header = " | ".join(table["header"])
        yield Grid.from_rows(title, header, map(tuple, table["rows"]), note, heads=2)


def _bar(thrown: ResultSet) -> str:
    """Return a sentence with errors and durations in the controller's model, relative to the
    paper's.
    """
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


def front_section(
    thrown: ResultSet,
    rows_of_panels: Sequence[dict[str, Any]] = PANELS,
    names: Sequence[str] = SHIPPED,
) -> Section:
    """Return the section with the sweep on each plant, as in :data:`PANELS`, the policies of these
    names, and sentences that compare them.
    """
    sentences: list = []
    sums: list = []
    missing: list = []
    picture = None
    panels = [_panel(thrown, names, sentences, sums, missing, **row) for row in rows_of_panels]
    lead = Text(
        f"Release speed, duration and energy weights are swept at {FRONT_TARGET:g} m. A setting"
        " counts if all its throws landed. Plans bound only the payload's path, as in the paper, or"
        " also the vehicle's thrust and its rotation. Lines join the settings that no other setting"
        " of their kind dominates; stars are the learnt policies with 95 % intervals."
    )
    if any(len(points) for panel in panels for _, _, points in panel.fronts):
        text = (
            "Agility against accuracy; closer to the lower left corner is better. On the plants the"
            " baseline's known delays are compensated, unless the legend states otherwise. Crosses"
            " and grey stars are the paper's."
        )
        picture = Picture("front", charts.trades(panels), text)
    header = (
        "plant | what | settings | all landed | fastest [s] | most accurate [m]"
        " | hypervolume [s m] | correlation of landing error with e_v"
    )
    time, error = front.CORNER
    note = (
        f"Hypervolume: area that is dominated up to {time:g} s and {error:g} m; more is better."
        " Correlations are over throws of all settings; the paper states that the error follows"
        " e_v."
    )
    table = Grid.from_rows("Fronts in figures", header, sums, note, heads=2)
    findings = (Text(text, "finding") for text in sentences)
    return parts.section(
        "front",
        "Agility against accuracy",
        lead,
        picture,
        table,
        *findings,
        _breakdown(thrown),
        missing=missing,
        head="Not swept",
    )


def _panel(
    thrown: ResultSet,
    names: Sequence[str],
    sentences: list,
    sums: list,
    missing: list,
    *,
    heading: str,
    plant: str,
    kinds: Sequence[Sequence[str]],
    policies_on: str,
) -> charts.Trade:
    """Return the panel of a row of :data:`PANELS` with fronts, policies and the paper's points;
    append to its ``sentences``, its table rows (``sums``) and ``missing``.
    """
    title = SHORT[plant]
    ideal = plant == thrower.IDEAL
    shipped = [(name, thrown.shipped_throws(name, policies_on, FRONT_TARGET)) for name in names]
    policies = [(name, result) for name, result in shipped if result and result.good.any()]
    fronts = []
    for i, (compensation, bounds) in enumerate(kinds):
        selected = _select_sweep(
            _find_baseline(thrown, plant, compensation=compensation, bounds=bounds)
        )
        label = f"TO+MPC, bounds on {bounds}"
        late = ", release lag not compensated" if compensation == "delay" else ""
        entry = (i, label + late, points_of(selected))
        if not ideal:
            label += f", {thrower.COMPENSATIONS[compensation]}"
        if selected:
            fronts.append(entry)
            sums.append(_summarise(title, label, selected))
            sentences += _verdicts(title, label, selected, policies, policies_on)
        elif (plant, bounds) != ("reference-realistic", BOUNDS[1]):
            missing.append(f"{title}, {label}")
    stars = []
    for name, result in policies:
        sums.append(_policy_sum(title, name, result))
        duration, error = (st.mean(result.of(column)) for column in ("duration", "error"))
        stars.append((f"{name} policy", duration, error))
    return charts.Trade(heading, tuple(fronts), tuple(stars), _paper_points() if ideal else ())


def _select_sweep(selected: Sequence[Result]) -> list[Result]:
    """Return the throws of the sweep, without the larger sets of the throws by target."""
    return [r for r in selected if r.unit["throws"] <= FRONT_THROWS or not _has_defaults(r)]


def points_of(selected: Sequence[Result]) -> ndarray:
    """Return mean duration [s] and landing error [m] of the settings whose throws all landed, shape
    (N, 2).
    """
    return np.array([_point(r) for r in selected if r.good.all()]).reshape(-1, 2)


def _point(result: Result) -> tuple[float, float]:
    return result.of("duration").mean(), result.of("error").mean()


def _paper_points() -> tuple[tuple[str, ndarray], ...]:
    swept = np.array([(row[4], row[3]) for row in PAPER_FRONT])
    vehicle = [PAPER[(name, FRONT_TARGET)] for name in SHIPPED]
    return (
        ("the paper's TO+MPC, its own model", swept),
        ("the paper's policies, real vehicle", np.array([(row[2], row[0]) for row in vehicle])),
    )


def hypervolume(selected: Sequence[Result]) -> st.Interval | None:
    """Return the hypervolume of the settings whose throws all landed, with its interval over
    throws; None without such settings.
    """
    sets = [np.column_stack([r.of("duration"), r.of("error")]) for r in selected if r.good.all()]
    if not sets:
        return None
    rng = np.random.default_rng(0)
    samples = []
    for _ in range(DRAWS):
        resampled = [s[rng.integers(len(s), size=len(s))].mean(0) for s in sets]
        samples.append(front.hypervolume(np.stack(resampled)))
    low, high = np.quantile(samples, (0.025, 0.975))
    value = front.hypervolume(np.stack([s.mean(0) for s in sets]))
    return st.Interval(value, float(low), float(high))


def _summarise(title: str, label: str, selected: Sequence[Result]) -> tuple[str, ...]:
    points = points_of(selected)
    volume = hypervolume(selected)
    head = (title, label, str(len(selected)), str(len(points)))
    if volume is None:
        return (*head, "-", "-", "-", "-")
    error, velocity = (
        np.concatenate([r.of(name) for r in selected if r.good.all()])
        for name in ("error", "velocity_error")
    )
    related = st.correlation(velocity, error).text(2) if len(error) > 2 else "-"
    fastest, nearest = points.min(0)
    return (*head, f"{fastest:.3f}", f"{nearest:.3f}", volume.text(3), related)


def _policy_sum(title: str, name: str, result: Result) -> tuple[str, ...]:
    volume = hypervolume([result])
    text = "-" if volume is None else volume.text(3)
    what = f"learnt {name} policy, {SHORT[result.unit['plant']]}"
    duration, error = _point(result)
    landed_all = str(int(result.good.all()))
    return (title, what, "1", landed_all, f"{duration:.3f}", f"{error:.3f}", text, "-")


def _verdicts(
    title: str,
    label: str,
    selected: Sequence[Result],
    policies: Sequence[tuple[str, Result]],
    policies_on: str,
) -> Iterator[str]:
    """Yield sentences on the paper's claim: no setting is as accurate and as fast as the policy,
    and the policy is faster than each more accurate setting.
    """
    points = points_of(selected)
    for name, result in policies:
        point = np.array(_point(result))
        head = (
            f"**{title}**, {label} against the {name} policy on the {SHORT[policies_on]}"
            f" ({point[0]:.3f} s, {point[1]:.3f} m): "
        )
        if not len(points):
            yield head + f"none of {_count(selected)} landed all its throws."
            continue
        beating = points[np.all(points <= point, axis=1)]
        faster, nearer = (points[points[:, i] < point[i]] for i in range(2))
        claim = "no setting is both as accurate and as fast"
        if len(beating):
            best = beating[np.argmin(beating[:, 0])]
            claim = f"{len(beating)} of {_count(points)} as accurate and as fast at once"
            claim += f", the fastest with {best[0]:.3f} s and {best[1]:.3f} m"
        speed = "the policy is faster than every setting"
        if len(faster):
            speed = f"faster than the policy: {_count(faster)}"
        accuracy = f"more accurate: {len(nearer)} of {_count(points)}"
        if len(nearer):
            slower = nearer[:, 0].min() / point[0]
            accuracy += f", the fastest of which takes {slower:.2f} times as long"
        yield f"{head}{claim}; {speed}; {accuracy}."


def _count(points: Sequence) -> str:
    return f"{len(points)} setting" + ("" if len(points) == 1 else "s")


def _breakdown(thrown: ResultSet) -> Grid | None:
    """Return a table of the paper's settings and ours in the controller's model."""
    selected = _select_sweep(_find_baseline(thrown, thrower.IDEAL))
    if not selected:
        return None
    rows = []
    for v, w_t, rho, e, d, p, u in PAPER_FRONT:
        figures_of_row = (f"{e:.3f}", f"{d:.3f}", f"{100 * p:.1f}", f"{100 * u:.1f}")
        rows.append((*_describe_setting(v, w_t, rho), "the paper's", *figures_of_row))
    for r in sorted(selected, key=lambda r: (r.unit["bounds"], r.unit["speed"], -r.unit["w_t"])):
        unit = r.unit
        head = (
            *_describe_setting(unit["speed"], unit["w_t"], unit["rho"]),
            f"bounds on {unit['bounds']}",
        )
        if r.good.all():
            row = _row(r)
            names = ("landing error [m]", "duration [s]", "e_p [cm]", "e_v [cm/s]")
            rows.append((*head, *(row[name] for name in names)))
        else:
            rows.append((*head, f"landed {format_landed_share(r, digits=0)}", "-", "-", "-"))
    header = "v [m/s] | w_t | rho | plan | landing error [m] | duration [s] | e_p [cm] | e_v [cm/s]"
    title = "Breakdown of the front in the own model; the paper's are of ten throws each"
    return Grid.from_rows(title, header, rows, heads=0)


def _describe_setting(speed: float, w_t: float, rho: float) -> tuple[str, str, str]:
    return f"{speed:g}", f"{w_t / 1e3:g}k", f"{rho:g}"
