"""Sections on extensions of the paper, on the training runs, and on the origin of the figures."""

import json
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from numpy import ndarray

from visthrow.paper.report import charts
from visthrow.paper.report.result_set import (
    SHIPPED,
    SHORT,
    WORDS,
    Points,
    ResultSet,
    cells,
    line,
)
from visthrow.paper.results import Result
from visthrow.view import parts
from visthrow.view.parts import Grid, Picture, Section, Text

TARGET = 2.0
SPEED_KEY = "task.target.speed"

TITLES: dict[str, str] = WORDS["beyond"]


def section(thrown: ResultSet) -> Section:
    """Return the section on moving targets, varied payloads, drag and far targets."""
    lead = Text(
        "Each is a switch of the task's config, off by default. Policies trained with it are"
        " compared with those trained without."
    )
    rows = []
    missing = []
    moving = _moving_goal_rows(thrown, missing)
    for variant in ("payload", "drag", "far"):
        results = thrown.find_results(kind="policy", variant=variant)
        if not results:
            missing.append(TITLES[variant])
        rows += _rows(results)
    rows += _rows(
        [
            r
            for r in thrown.find_results(kind="policy")
            if r.unit["policy"] in SHIPPED and _is_beyond(r)
        ]
    )
    header = (
        "policy | training | plant | flown with | target [m] | throws | landed | landing error [m]"
    )
    note = "'its own': the conditions of its own training; otherwise the changes."
    table = Grid.from_rows("Payload, drag and distance", header, rows, note, heads=4)
    return parts.section("beyond", "Beyond the paper", lead, *moving, table, missing=missing)


def _is_beyond(result: Result) -> bool:
    """Return whether a shipped policy's throws belong to the table: the target is far, or something
    other than camera, noise, observation or speed was changed.
    """
    elsewhere = ("camera.", "task.noise", "task.observation", SPEED_KEY)
    return result.unit["target"] > 2.5 or any(
        not key.startswith(elsewhere) for key in result.unit["departures"]
    )


def _rows(results: list[Result]) -> Iterator[dict[str, str]]:
    def question(result: Result) -> str:
        return json.dumps([result.unit[key] for key in ("policy", "plant", "departures", "target")])

    for result in sorted(results, key=question):
        variant = result.unit["variant"]
        changes = _changes(result.unit["departures"])
        yield {**cells(result), "training": TITLES.get(variant, variant), "flown with": changes}


def _changes(departures: dict) -> str:
    """Return the changes as a text, in words or as keys without their tables."""
    values = {key.split(".")[-1]: value for key, value in departures.items()}
    if "payload_spread" not in values:
        words = [f"{key.split('.')[-1]} {json.dumps(value)}" for key, value in departures.items()]
        return ", ".join(words) or "its own"
    if not values["payload_spread"] > 0.0:
        return "one payload, no drag"
    drag = ", drag varied" if values.get("drag_spread", 0.0) > 0.0 else ""
    return (
        f"payload ±{100 * values['payload_spread']:.0f} %, cable"
        f" ±{100 * values.get('tether_spread', 0.06):.0f} %{drag}"
    )


def _speeds(thrown: ResultSet, policy: str, plant: str) -> Points:
    """Return speeds of the target [m/s], ascending, and a policy's throws at each."""
    points = [
        (float(speed[1]), result)
        for speed, result in thrown.throws_by_value(policy, SPEED_KEY, plant, TARGET)
        if speed[0] == speed[1]
    ]
    return sorted(points, key=lambda point: point[0])


def _moving_goal_rows(thrown: ResultSet, missing: list[str]) -> list:
    names = sorted({r.unit["policy"] for r in thrown.find_results(kind="policy", variant="moving")})
    if not names:
        missing.append(TITLES["moving"])
    lines = []
    rows = []
    for plant in ("hybrid", "reference-realistic"):
        for policy in (*names, *SHIPPED):
            points = _speeds(thrown, policy, plant)
            if plant == "hybrid" and points:
                label = policy
                if policy in SHIPPED:
                    label = f"{policy}, {TITLES['full']}"
                    reference = thrown.shipped_throws(policy, plant, TARGET)
                    if reference is not None and points[0][0] > 0.0:
                        points = [(0.0, reference), *points]
                if len(points) > 1:
                    lines.append(line(label, points, len(lines)))
            rows += [{**cells(r), "speed [m/s]": f"{speed:g}"} for speed, r in points]
    content: list = []
    if lines:
        panel = charts.Panel(
            "targets that move, from 2.0 m ahead in any direction",
            "speed of the target [m/s]",
            tuple(lines),
        )
        text = (
            "Landing error against where the target is at impact, in the training simulator; bands"
            " are 95 % intervals."
        )
        content.append(Picture("moving", charts.curves([panel], "landing error [m]"), text))
    header = "policy | plant | speed [m/s] | throws | landed | landing error [m]"
    return [*content, Grid.from_rows("Moving targets", header, rows)]


def training_section(thrown: ResultSet) -> Section:
    """Return the section with all training runs and their durations."""
    runs = thrown.runs
    if not runs:
        none = Text(
            "No training is recorded: `visthrow sweep run paper`, then `visthrow sweep collect"
            " paper`.",
            "missing",
        )
        return parts.section("training", "Training runs", none)
    total = sum(_seconds(run) or 0.0 for run in runs)
    lead = Text(
        f"{len(runs)} trainings, {total / 60:.0f} minutes in all, each on the device that"
        " its row names."
    )
    groups: dict[str, list[ndarray]] = defaultdict(list)
    for run in runs:
        points = [point for point in run.get("curve", []) if None not in point]
        if len(points) > 1:
            curve = np.array(points, dtype=float)
            groups[run["run"].replace("_", " ")].append(curve[:, [0, 2]].T)
    picture = None
    if groups:
        text = (
            "Landing error in training, with random starts and goals, over environment steps; one"
            " colour for each seed."
        )
        picture = Picture("learning", charts.draw_learning(list(groups.items())), text)
    header = (
        "run | seed | million steps | pieces | time [s] | final error [m] | final duration [s]"
        " | device | commit"
    )
    note = (
        "Time: all pieces of the run. Final: throws from hover at 2.0 m in its own simulator, at"
        " the end of the training."
    )
    table = Grid.from_rows("Training runs", header, map(_run_row, runs), note)
    return parts.section("training", "Training runs", lead, picture, table)


def _seconds(run: dict) -> float | None:
    return run.get("wall_s") or run.get("seconds")


def _run_row(run: dict) -> tuple[str, ...]:
    final = run.get("final") or {}

    def number(value, form: str = "{:.3f}") -> str:
        return "-" if value is None else form.format(value)

    device = run.get("device", "-")
    return (
        run["name"].rpartition("-")[0] or run["run"],
        str(run.get("train_seed", "-")),
        number((run.get("steps") or 0) / 1e6, "{:.0f}"),
        str(run.get("pieces", "-")),
        number(_seconds(run), "{:.0f}"),
        number(final.get("error_mean")),
        number(final.get("duration_mean")),
        device if isinstance(device, str) else ", ".join(map(str, device)),
        str(run.get("commit", "-"))[:9],
    )


def origin_section(thrown: ResultSet) -> Section:
    """Return the section with the command, commit and seeds of all throws."""
    groups: dict[tuple[str, ...], list] = defaultdict(list)
    for r in thrown.results:
        command = r.provenance.get("command", "-").split(" (")[0]
        commit = str(r.provenance.get("commit", "-"))[:12]
        groups[command, commit, SHORT[r.unit["plant"]]].append(r)
    rows = []
    for origin, records in sorted(groups.items()):
        times = sorted(str(r.provenance.get("time", "-"))[:10] for r in records)
        seeds = ", ".join(sorted({str(r.unit["seed"]) for r in records}))
        seconds = sum(r.provenance.get("seconds", 0.0) for r in records)
        throws = sum(len(r.good) for r in records)
        days = " to ".join(dict.fromkeys((times[0], times[-1])))
        rows.append((*origin, str(len(records)), str(throws), seeds, days, f"{seconds:.0f}"))
    lead = Text(
        "Seeds of throws determine starts, vehicles, winds and noise, which are the same for"
        " policies and baseline. Intervals are percentile bootstrap intervals of 95 %; with several"
        " trainings, runs and throws are drawn in two levels. Throws that did not land have no"
        " error and lower 'landed'."
    )
    header = "command | commit | plant | sets | throws | seeds | made on | seconds of work"
    table = Grid.from_rows("Throws behind this page", header, rows, heads=3)
    return parts.section(
        "origin",
        "Where the figures come from",
        lead,
        table or Text("No throws are recorded.", "missing"),
    )
