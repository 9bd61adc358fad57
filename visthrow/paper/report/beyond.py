"""Sections on what goes beyond the paper, on the training runs, and on where the
figures come from.
"""

import json
from collections import defaultdict

import numpy as np

from visthrow.common import statistics as st
from visthrow.paper.report.result_set import SHIPPED, ResultSet, landed
from visthrow.paper.report.throws import SHORT
from visthrow.throws.results import Result
from visthrow.view import figures, parts
from visthrow.view.parts import Grid, Picture, Section, Text

TARGET = 2.0
SPEED_KEY = "task.target.speed"

VARIANTS = ("moving", "payload", "drag", "far")
TITLES = {
    "moving": "trained on moving targets",
    "payload": "trained on varied payloads and cables",
    "drag": "trained with drag after the release",
    "far": "trained on targets to 3 m",
    "full": "trained as usual",
}


def section(thrown: ResultSet) -> Section:
    """Report moving targets, varied payloads, drag and far targets."""
    lead = Text(
        "Each is a switch of the task's config, off by default. Policies trained with it stand"
        " beside those trained without."
    )
    rows = []
    missing = []
    table = None
    moving = _moving(thrown, missing)
    for variant in VARIANTS[1:]:
        results = thrown.matching(kind="policy", variant=variant)
        if not results:
            missing.append(TITLES[variant])
        rows += _rows(results)
    rows += _rows(
        [r for r in thrown.matching(kind="policy") if r.unit["policy"] in SHIPPED and _is_beyond(r)]
    )
    if rows:
        head = (
            "policy",
            "training",
            "plant",
            "flown with",
            "target [m]",
            "throws",
            "landed",
            "landing error [m]",
        )
        note = "'its own': the conditions of its own training; else what was changed."
        table = Grid("Payload, drag and distance", head, tuple(rows), note, heads=4)
    return parts.section("beyond", "Beyond the paper", lead, *moving, table, missing=missing)


def _is_beyond(result: Result) -> bool:
    """Whether a shipped policy's throws belong to the table: more than camera or noise was changed,
    or it was far.
    """
    elsewhere = ("camera.", "task.noise", "task.observation", SPEED_KEY)
    return result.unit["target"] > 2.5 or any(
        not key.startswith(elsewhere) for key in result.unit["departures"]
    )


def _rows(results: list[Result]) -> list[tuple[str, ...]]:
    rows = []
    for r in sorted(
        results,
        key=lambda r: json.dumps([r.unit[k] for k in ("policy", "plant", "departures", "target")]),
    ):
        unit = r.unit
        error = st.mean(r.of("error")).text() if r.good.any() else "-"
        trained = TITLES.get(unit["variant"], unit["variant"])
        changes = _changes(unit["departures"])
        rows.append(
            (
                unit["policy"],
                trained,
                SHORT[unit["plant"]],
                changes,
                f"{unit['target']:.1f}",
                str(len(r.good)),
                landed(r),
                error,
            )
        )
    return rows


def _changes(departures: dict) -> str:
    """Return the changes in words, or as keys without their tables."""
    values = {key.split(".")[-1]: value for key, value in departures.items()}
    if "payload_spread" in values and values["payload_spread"] > 0.0:
        drag = ", drag varied" if values.get("drag_spread", 0.0) > 0.0 else ""
        return (
            f"payload ±{100 * values['payload_spread']:.0f} %, cable"
            f" ±{100 * values.get('tether_spread', 0.06):.0f} %{drag}"
        )
    if "payload_spread" in values:
        return "one payload, no drag"
    return (
        ", ".join(f"{key.split('.')[-1]} {json.dumps(value)}" for key, value in departures.items())
        or "its own"
    )


def _speeds(
    thrown: ResultSet, policies: list[str], plant: str
) -> dict[str, list[tuple[float, Result]]]:
    """Policy -> ascending speeds of the target [m/s] and throws."""
    curves: dict[str, list[tuple[float, Result]]] = {}
    for policy in policies:
        for r in thrown.matching(kind="policy", policy=policy, plant=plant, target=TARGET):
            speed = r.unit["departures"].get(SPEED_KEY)
            if (
                speed is not None
                and len(r.unit["departures"]) == 1
                and speed[0] == speed[1]
                and r.good.any()
            ):
                curves.setdefault(policy, []).append((float(speed[1]), r))
    return {policy: sorted(points, key=lambda p: p[0]) for policy, points in curves.items()}


def _moving(thrown: ResultSet, missing: list[str]) -> list:
    names = sorted({r.unit["policy"] for r in thrown.matching(kind="policy", variant="moving")})
    if not names:
        missing.append(TITLES["moving"])
    lines = []
    rows = []
    for policy, points in _speeds(thrown, [*names, *SHIPPED], "hybrid").items():
        label = policy
        if policy in SHIPPED:
            label = f"{policy}, {TITLES['full']}"
            reference = thrown.shipped(policy, "hybrid", TARGET)
            if reference is not None and points[0][0] > 0.0:
                points = [(0.0, reference), *points]
        if len(points) > 1:
            speeds = [speed for speed, _ in points]
            intervals = [st.mean(r.of("error")) for _, r in points]
            lines.append(figures.Line(label, speeds, intervals, len(lines)))
        rows += [_moving_row(policy, *point) for point in points]
    for policy, points in _speeds(thrown, [*names, *SHIPPED], "reference-realistic").items():
        rows += [_moving_row(policy, *point) for point in points]
    content: list = []
    if lines:
        panel = figures.Panel(
            "targets that move, from 2.0 m ahead in any direction",
            "speed of the target [m/s]",
            tuple(lines),
        )
        text = (
            "Landing error against where the target is at impact, in the training simulator; bands"
            " are 95 % intervals."
        )
        content.append(Picture("moving", figures.curves([panel], "landing error [m]"), text))
    if rows:
        head = ("policy", "plant", "speed [m/s]", "throws", "landed", "landing error [m]")
        content.append(Grid("Moving targets", head, tuple(rows)))
    return content


def _moving_row(policy: str, speed: float, result: Result) -> tuple[str, ...]:
    error = st.mean(result.of("error")).text()
    plant = SHORT[result.unit["plant"]]
    return (policy, plant, f"{speed:g}", str(len(result.good)), landed(result), error)


def training_section(thrown: ResultSet) -> Section:
    """Every training run with its time."""
    if not thrown.runs:
        none = Text(
            "No training is recorded: `visthrow sweep run paper`, then `visthrow sweep collect"
            " paper`.",
            "missing",
        )
        return parts.section("training", "Training runs", none)
    total = sum(run.get("wall_s") or run.get("seconds") or 0.0 for run in thrown.runs)
    lead = Text(
        f"{len(thrown.runs)} trainings, {total / 60:.0f} minutes in all, each on the device that"
        " its row names."
    )
    groups: dict[str, list[np.ndarray]] = {}
    rows = []
    picture = None
    for run in thrown.runs:
        curve = np.array(
            [point for point in run.get("curve", []) if None not in point], dtype=float
        ).reshape(-1, 3)
        if len(curve) > 1:
            groups.setdefault(run["run"].replace("_", " "), []).append(curve[:, [0, 2]].T)
        rows.append(_run_row(run))
    if groups:
        text = (
            "Landing error of the training's own throws, random starts and goals, over environment"
            " steps; a colour a seed."
        )
        picture = Picture("learning", figures.learning(list(groups.items())), text)
    head = (
        "run",
        "seed",
        "million steps",
        "pieces",
        "time [s]",
        "final error [m]",
        "final duration [s]",
        "device",
        "commit",
    )
    note = (
        "Time: all pieces of the run. Final: throws from hover at 2.0 m in its own simulator, at"
        " the end of the training."
    )
    return parts.section(
        "training", "Training runs", lead, picture, Grid("Training runs", head, tuple(rows), note)
    )


def _run_row(run: dict) -> tuple[str, ...]:
    final = run.get("final") or {}

    def number(value, form: str = "{:.3f}") -> str:
        return "-" if value is None else form.format(value)

    device = run.get("device", "-")
    seconds = run.get("wall_s") or run.get("seconds")
    return (
        run["name"].rpartition("-")[0] or run["run"],
        str(run.get("train_seed", "-")),
        number((run.get("steps") or 0) / 1e6, "{:.0f}"),
        str(run.get("pieces", "-")),
        number(seconds, "{:.0f}"),
        number(final.get("error_mean")),
        number(final.get("duration_mean")),
        device if isinstance(device, str) else ", ".join(map(str, device)),
        str(run.get("commit", "-"))[:9],
    )


def origin_section(thrown: ResultSet) -> Section:
    """Return a row for each command and commit that made throws, and seeds."""
    groups: dict[tuple[str, ...], list] = defaultdict(list)
    for r in thrown.results:
        origin = r.provenance
        groups[
            (
                origin.get("command", "-").split(" (")[0],
                str(origin.get("commit", "-"))[:12],
                SHORT[r.unit["plant"]],
            )
        ].append(r)
    rows = []
    for (command, commit, plant), records in sorted(groups.items()):
        times = sorted(str(r.provenance.get("time", "-"))[:10] for r in records)
        seeds = ", ".join(sorted({str(r.unit["seed"]) for r in records}))
        seconds = sum(r.provenance.get("seconds", 0.0) for r in records)
        throws = sum(len(r.good) for r in records)
        rows.append(
            (
                command,
                commit,
                plant,
                str(len(records)),
                str(throws),
                seeds,
                times[0] if times[0] == times[-1] else f"{times[0]} to {times[-1]}",
                f"{seconds:.0f}",
            )
        )
    lead = Text(
        "Seeds of throws fix starts, vehicles, winds and noise: policies and baseline meet the same"
        " ones. Intervals are percentile bootstrap intervals of 95 %; 'runs and throws' are drawn"
        " in two levels where there are several trainings. Throws that did not land have no error"
        " and count against 'landed'."
    )
    head = ("command", "commit", "plant", "sets", "throws", "seeds", "made on", "seconds of work")
    if rows:
        table = Grid("Throws behind this page", head, tuple(rows), heads=3)
    else:
        table = Text("No throws are recorded.", "missing")
    return parts.section("origin", "Where the figures come from", lead, table)
