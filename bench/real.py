"""Diagnoses of published recorded flights, of traps made from them, and their gain on held-out
flights.

``python -m bench.real --data FOLDER --jobs 8 --json record.json``; ``--only NAME`` runs the
cases whose names hold it. Three tables:

- - sets: each through `explain`. KNOWN requires that no interval of the held-out gain includes 0.
  With test flights, the share of their error above the noise that the sizes written by `apply`
  remove.
- - traps: deliberately damaged flights. The answer must name the damage, or be an error that does.
- - parts: separate flights of one vehicle. An effect that one of two parts names must agree with
  the other within both intervals, widened by their spread from flight to flight.
"""

import argparse
import json
import re
import resource
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from examples.gimbal.gimbal_model import SLUNG_LOAD, GimbalModel
from examples.pendulum.swing_model import ENCODER, PendulumModel
from examples.trim.trim_model import E8, E9, UNTRIMMED, TrimModel
from visthrow.common import provenance, workers
from visthrow.common.storage import write_json
from visthrow.diagnose.apply.saved_diagnosis import SavedDiagnosis
from visthrow.diagnose.inputs import setup as setups
from visthrow.diagnose.likelihood.evidence import NORMAL_95
from visthrow.diagnose.models.numeric import NumericModel
from visthrow.diagnose.reporting import diagnosis_report as report
from visthrow.diagnose.reporting.gain import evaluate_on_others
from visthrow.diagnose.select import result
from visthrow.diagnose.select.diagnose_flights import diagnose
from visthrow.logs.check.run import check
from visthrow.logs.flightlog import Channel, FlightLog

Logs = list[FlightLog]
PATHS = ("pos_w", "vel_w", "payload_pos_w", "payload_vel_w", "est_pos_w")
AIRBORNE = ("quat_wb", "rate_b", "acc_b", "thrust_command")
LATE = 0.1
"""Delay of a trap's streams [s]."""

TWO_CABLES = """base = "cf_payload_pair.toml"
[flyer]
input = "thrust_command"
position = "pos_w"
attitude = "quat_wb"
mass = 0.0345
gravity = 9.81
thrust_map = [0.0, 1.0, 0.0]
motor_time_constant = 0.03
command_delay = 0.0
reference_voltage = 3.7
voltage_coefficient = 0.0
drag_xy = 0.0
drag_z = 0.0
lowest = 0.3
window = 1.0
step = 0.02
every = 3
most_windows = 24
[flyer.cable]
length = 0.5
mass = 0.010
"""
"""One of two vehicles on one load, diagnosed as if it carried it alone."""

EXAMPLES: dict[str, tuple[str, Callable[[Logs], NumericModel]]] = {
    "pendulum": ("pendulum_encoder", lambda logs: PendulumModel(logs, ENCODER)),
    "gimbal": ("slungload_camera", lambda logs: GimbalModel(logs, SLUNG_LOAD)),
    "trim of E8": ("crazypad", lambda logs: TrimModel(logs, E8)),
    "trim of E9": ("crazypad", lambda logs: TrimModel(logs, E9)),
    "untrimmed": ("crazypad", lambda logs: TrimModel(logs, UNTRIMMED)),
}
"""Models of examples, each with the setup that maps its columns."""


@dataclass(frozen=True)
class Case:
    """One case: logs, a setup and the expected answer."""

    name: str
    setup: str  # of configs/diagnose, the text of one, or one of EXAMPLES
    files: tuple[str, ...]  # below the folder of the data
    change: Callable[[Logs], Logs] = list
    test: tuple[str, ...] = ()  # held-out flights
    of_test: Callable[[Logs], Logs] = list  # what of these
    expect: str = ""  # of a trap: a regular expression that its answer must match
    of: str = ""  # of a part: the vehicle


def change_channels(
    names: Sequence[str], change: Callable[[np.ndarray], np.ndarray]
) -> Callable[[Logs], Logs]:
    """Return a change of some channels' values in all logs."""

    def one(log: FlightLog) -> FlightLog:
        chosen = {n: c for n, c in log.channels.items() if n in names}
        return FlightLog(
            {
                **log.channels,
                **{n: replace(c, values=change(c.values.astype(float))) for n, c in chosen.items()},
            },
            log.meta,
        )

    return lambda logs: [one(log) for log in logs]


def delay_stamps(names: Sequence[str], by: float = LATE) -> Callable[[Logs], Logs]:
    """Return a change that delays some channels' stamps in all logs."""
    return lambda logs: [
        FlightLog(
            {n: replace(c, time=c.time + by) if n in names else c for n, c in log.channels.items()},
            log.meta,
        )
        for log in logs
    ]


def change_first(change: Callable[[Logs], Logs]) -> Callable[[Logs], Logs]:
    """Return a change of the first log alone."""
    return lambda logs: [*change(logs[:1]), *logs[1:]]


def cut(begin: float, end: float) -> Callable[[Logs], Logs]:
    """A share of each log's time."""

    def one(log: FlightLog) -> FlightLog:
        start = min(c.time[0] for c in log.channels.values())
        span = max(c.time[-1] for c in log.channels.values()) - start
        keep = {
            n: (c.time >= start + begin * span) & (c.time < start + end * span)
            for n, c in log.channels.items()
        }
        return FlightLog(
            {
                n: Channel(c.time[keep[n]], c.values[keep[n]], c.unit, c.frame, c.valid[keep[n]])
                for n, c in log.channels.items()
            },
            log.meta,
        )

    return lambda logs: [one(log) for log in logs]


def share(k: int, of: int = 3) -> Callable[[Logs], Logs]:
    """Every so-manieth log."""
    return lambda logs: logs[k::of]


def keep_others(k: int, of: int = 3) -> Callable[[Logs], Logs]:
    """All others."""
    return lambda logs: [log for i, log in enumerate(logs) if i % of != k]


def another_thrust(logs: Logs) -> Logs:
    """Each flight with the thrust of the next one."""
    others = logs[1:] + logs[:1]
    return [
        FlightLog({**log.channels, "thrust_command": o["thrust_command"]}, log.meta)
        for log, o in zip(logs, others)
    ]


def scale_thrust_unevenly(logs: Logs) -> Logs:
    """Thrust in another scale in each flight."""
    return [
        change_channels(["thrust_command"], lambda v, f=f: f * v)([log])[0]
        for log, f in zip(logs, (0.75, 1.0, 1.3))
    ]


def dead_rotor(logs: Logs) -> Logs:
    """The rear left motor's channel reads half."""
    return change_channels(["motor_command"], lambda v: v * [1.0, 1.0, 0.5, 1.0])(logs)


def winds(_: Logs) -> Logs:
    """Six simulated flights in three wind speeds: no recorded set has wind."""
    from bench.diagnose.flown import fly

    return [fly(8.0, drag=0.03, wind=wind, seed=i) for i, wind in enumerate((-2.0, 0.5, 3.0) * 2)]


def throw_spinning_balls(_: Logs) -> Logs:
    """Sixty throws of a ball with drag and much spin."""
    from bench.diagnose.flown import ball_log

    return [ball_log(drag=0.12, spin=(0.0, 0.0, 1.2), seed=i, heading=2.1 * i) for i in range(60)]


WINDY = """about = "the vehicle of the simulated flights"
[flyer]
input = "motor_command"
position = "pos_w"
attitude = "quat_wb"
mass = 0.03
gravity = 9.81
thrust_map = [0.0, 0.06, 0.1]
motor_time_constant = 0.03
command_delay = -0.005
reference_voltage = 3.8
voltage_coefficient = 0.0
drag_xy = 0.03
drag_z = 0.0
lowest = -10.0
window = 1.0
step = 0.02
every = 1
most_windows = 40
"""
BALL = (
    'about = "the ball of the simulated throws"\n[ball]\ngravity = 9.81\ndrag = 0.0\nedge ='
    " 0.02\nshortest = 0.3\nevery = 1\n"
)

CF = tuple(f"payload_cf_single/log{n}.csv.gz" for n in (201, 202, 204, 205, 206))
CF3 = CF[2:]
NANO = tuple(
    f"nanobench_cf21/{n}.csv.gz"
    for n in (
        "B10_lissajous_fast_rep1",
        "B2_circle_fast_rep3",
        "B3_figure8_fast_rep1",
        "B8_star_fast_rep3",
    )
)
PAD = "crazypad_faults/"
SLUNG = ("slungload_camera/rosbag_16.csv.gz", "slungload_camera/rosbag_17.csv.gz")
BALLS = ("jugglebot_throws/session7.csv.gz", "jugglebot_throws/session3_timing.csv.gz")
SWING = ("pendulum_single/single_pendulum_id.csv.gz",)
STAND = "motor_prop_stand/all_tests.csv.gz"


def _predict_each(files: Sequence[str], setup: str, name: str) -> list[Case]:
    """Each flight of a set predicted from the others."""
    return [
        Case(
            f"set {name}, {Path(f).name.split('.')[0]} unseen",
            setup,
            tuple(o for o in files if o != f),
            test=(f,),
        )
        for f in files
    ]


SETS = (
    *_predict_each(NANO, "nanobench_cf21", "nanobench"),
    *_predict_each(CF, "cf_payload", "payload_cf_single"),
    Case("set slungload, bag 17 unseen", "gimbal", SLUNG[:1], test=SLUNG[1:]),
    Case("set slungload, bag 16 unseen", "gimbal", SLUNG[1:], test=SLUNG[:1]),
    # between these sessions the capture was calibrated anew (the repository's notes on them): its
    # frame is turned by 0.8 deg about x, which the other session does not know
    Case("set jugglebot, session 3 unseen", "jugglebot", BALLS[:1], test=BALLS[1:]),
    Case("set jugglebot, session 7 unseen", "jugglebot", BALLS[1:], test=BALLS[:1]),
    *(
        Case(
            f"set jugglebot, third {k + 1} of session {n} unseen",
            "jugglebot",
            (file,),
            keep_others(k),
            test=(file,),
            of_test=share(k),
        )
        for n, file in zip((7, 3), BALLS)
        for k in range(3)
    ),
    Case("set pendulum", "pendulum", SWING),
    Case(
        "set pendulum, last third unseen",
        "pendulum",
        SWING,
        cut(0.0, 0.667),
        test=(f"{SWING[0]}@0.667",),
    ),
    *(
        Case(
            f"set crazypad {drone}, log03 unseen",
            "untrimmed",
            (f"{PAD}normal_flight__{drone}_log00.csv.gz",),
            test=(f"{PAD}normal_flight__{drone}_log03.csv.gz",),
        )
        for drone in ("E8", "E9")
    ),
    Case(
        "set motor stand a1, 11 V unseen",
        "motor_stand",
        (f"{STAND}:a1_7",),
        test=(f"{STAND}:a1_11",),
    ),
    Case("set motor stand, all motors", "motor_stand", (STAND,)),
    *(
        Case(
            f"set crazypad {n.split('__')[0]}",
            "trim of E9" if "E9" in n else "trim of E8",
            (f"{PAD}{n}.csv.gz",),
        )
        for n in (
            "cut_propeller_M3_2.5mm_2.5mm_42mm__E8_log00",
            "tape_on_propeller_M3__E8_log00",
            "weight_on_string_W2_near_M3__E8_log00",
            "add_weight_W1_near_M3__E9_log04",
            "normal_flight__E8_log05",
        )
    ),
)


def _spoil(name: str, change: Callable[[Logs], Logs], expect: str) -> Case:
    """Three flights of a Crazyflie, changed."""
    return Case(f"trap {name}", "cf_payload", CF3, change, expect=expect)


LATER = r"clocks apart|stream of the thrust|ms (late|early|behind)"
TRAPS = (
    _spoil(
        "x and y of positions exchanged",
        change_channels(PATHS, lambda v: v[:, [1, 0, 2]]),
        r"\(y,x,z\) of positions",
    ),
    _spoil(
        "y mirrored", change_channels(PATHS, lambda v: v * [1, -1, 1]), r"\(x,-y,z\) of positions"
    ),
    Case(
        "trap attitude, IMU and thrust late",
        "cf_payload",
        CF3,
        delay_stamps(AIRBORNE),
        expect=LATER,
    ),
    Case("trap payload late", "cf_payload", CF3, delay_stamps(["payload_pos_w"]), expect=LATER),
    _spoil(
        "one of three logs late",
        change_first(delay_stamps(AIRBORNE)),
        rf"left out: log204.*({LATER})",
    ),
    _spoil(
        "thrust of another flight", another_thrust, r"thrust of another flight|stream of the thrust"
    ),
    Case(
        "trap a copy of a log",
        "cf_payload",
        (*CF3, CF3[0]),
        expect=r"a copy of another log, which counts once",
    ),
    _spoil(
        "thrust in grams",
        change_channels(["thrust_command"], lambda v: v / 9.80665e-3),
        r"in g of thrust|another unit",
    ),
    _spoil("rates in degrees", change_channels(["rate_b"], np.degrees), r"one is in degrees"),
    _spoil(
        "positions in millimetres",
        change_channels(PATHS, lambda v: 1e3 * v),
        r"millimetres taken for metres",
    ),
    _spoil(
        "thrust's scale differs by flight",
        scale_thrust_unevenly,
        r"VARIES[^\n]*(thrust|mass)|differs from flight to flight",
    ),
    Case(
        "trap a rotor's sensor reads half",
        "nanobench_cf21",
        NANO[2:3],
        dead_rotor,
        expect=r"rear left reads 0\.\d+ of the others",
    ),
    Case(
        "trap two cables taken for one",
        TWO_CABLES,
        tuple(f"payload_cf_two_drones/coltrans_{n}.csv.gz" for n in ("02_cf3", "11_cf3")),
        expect=r"^(UNKNOWN|EXPLAINED IN PART|OUT OF DOMAIN|DATA INCONSISTENT)",
    ),
    Case(
        "trap winds of three strengths", WINDY, (), winds, expect=r"besides gust|VARIES[^\n]*wind"
    ),
    Case(
        "trap sixty spinning balls",
        BALL,
        (),
        throw_spinning_balls,
        expect=r"(?s)FOUND[^\n]*(spin|drag).*60 windows of 60 flights",
    ),
)

PARTS = (
    *(
        Case(f"part nanobench {Path(f).name[:3]}", "nanobench_cf21", (f,), of="nanobench")
        for f in NANO
    ),
    *(
        Case(
            f"part payload_cf_single {Path(f).name[:6]}", "cf_payload", (f,), of="payload_cf_single"
        )
        for f in CF[:4]
    ),
    *(
        Case(
            f"part slungload {Path(f).name[7:9]} {k + 1} of 3",
            "gimbal",
            (f,),
            cut(k / 3, (k + 1) / 3),
            of="slungload",
        )
        for f in SLUNG
        for k in range(3)
    ),
    *(
        Case(
            f"part jugglebot session 7, {k + 1} of 3",
            "jugglebot",
            BALLS[:1],
            share(k),
            of="jugglebot 7",
        )
        for k in range(3)
    ),
    *(
        Case(
            f"part jugglebot session 3, {k + 1} of 3",
            "jugglebot",
            BALLS[1:],
            share(k),
            of="jugglebot 3",
        )
        for k in range(3)
    ),
    *(
        Case(
            f"part pendulum {k + 1} of 3",
            "pendulum",
            SWING,
            cut(k / 3, (k + 1) / 3),
            of="pendulum",
        )
        for k in range(3)
    ),
    *(
        Case(
            f"part crazypad E8 log0{k}",
            "untrimmed",
            (f"{PAD}normal_flight__E8_log0{k}.csv.gz",),
            of="crazypad E8",
        )
        for k in (0, 3, 5)
    ),
)


def _open_setup(text: str, folder: Path) -> tuple[str, Callable[[Logs], NumericModel]]:
    """Return the setup that reads a case's logs, and what makes its model of them."""
    if text in EXAMPLES:
        return EXAMPLES[text]
    name = text
    if "\n" in text:
        name = str(folder / "setup.toml")
        base = re.sub(r'base = "(\w+)\.toml"', r'base = "diagnose/\1.toml"', text)
        Path(name).write_text(base)
    setup = setups.load(name)
    return name, lambda logs: setups.model_of(setup, logs)


def _read(files: Sequence[str], data: Path, setup: str) -> Logs:
    """Logs; ``FILE@SHARE``: from this share of its time on."""
    read: Logs = []
    for file in files:
        name, _, begin = file.partition("@")
        logs = setups.read_logs([data / name], setup)
        read += cut(float(begin), 1.01)(logs) if begin else logs
    return read


def run(task: tuple[Case, Path]) -> dict:
    """Diagnose a case; returns its row as plain data."""
    case, data = task
    begun = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    with tempfile.TemporaryDirectory() as folder:
        name, model_of = _open_setup(case.setup, Path(folder))
        known = setups.describe_vehicle(name)
        logs = case.change(_read(case.files, data, name))
        try:
            diagnosis = diagnose(logs, model_of(logs), vehicle=known)
            text = report.summary(diagnosis)
        except Exception as error:  # the user's error message
            text = f"error: {error}\n" + "\n".join(
                f"{r.topic} {r.channel}: {r.text}"
                for c in check(logs, known)
                for r in c.rows
                if r.verdict == "bad"
            )
            return {
                "case": case.name,
                "said": text,
                "overall": "error",
                "ok": bool(case.expect and re.search(case.expect, text)),
            }
        held = diagnosis.held_out.channels if diagnosis.held_out else ()
        row = {
            "case": case.name,
            "of": case.of,
            "overall": diagnosis.overall,
            "named": list(diagnosis.theta),
            "said": text.split("\n\n")[0],
            "varies": [s.name for s in diagnosis.scatter if s.found],
            "gain": {c.channel: [c.before, c.after, c.floor, c.gain, c.low, c.high] for c in held},
            "sizes": {
                f.name: [f.estimate, f.low, f.high, f.verdict, f.differs]
                for f in diagnosis.findings
                if f.high > f.low and case.of
            },
            "partners": {name: diagnosis[name].partners for name in diagnosis.theta},
        }
        if case.expect:
            row["ok"] = bool(re.search(case.expect, text))
        if case.test and diagnosis.theta:
            unseen = case.of_test(_read(case.test, data, name))
            row["unseen"] = _measure_unseen(diagnosis, model_of(unseen), model_of(unseen))
        return row | {"cpu_s": resource.getrusage(resource.RUSAGE_SELF).ru_utime - begun}


def _measure_unseen(
    diagnosis: result.Diagnosis, plain: NumericModel, extended: NumericModel
) -> dict[str, list[float]]:
    """Return errors on held-out flights of the plain model and of one with the sizes that `apply`
    writes, and of noise alone.
    """
    extended.extend(SavedDiagnosis(report.to_json(diagnosis), "the diagnosis").sizes[0])
    measured = evaluate_on_others(plain, extended, {}, diagnosis).errors
    return {channel: list(errors) for channel, errors in measured.items()}


def share_removed(errors: Sequence[float]) -> float:
    """Share of the error above the noise that is removed."""
    before, after, floor = errors
    return (before - after) / (before - floor)


def agreement(rows: Sequence[dict]) -> list[tuple[str, str, str, bool]]:
    """For each pair of one vehicle's parts and each name of either: whether their sizes agree
    within the sum of both intervals.

    A class agrees where one of its members does.
    """
    agreements = []
    for a, b in combinations(rows, 2):
        if a["of"] != b["of"]:
            continue
        names = {name: {name, *one["partners"][name]} for one in (a, b) for name in one["named"]}
        for name, members in sorted(names.items()):
            both = [m for m in members if m in a["sizes"] and m in b["sizes"]]
            if both:
                agreements.append(
                    (
                        a["case"],
                        b["case"],
                        name,
                        any(_one_size(a["sizes"][m], b["sizes"][m]) for m in both),
                    )
                )
    return agreements


def _one_size(a: Sequence, b: Sequence) -> bool:
    """Whether two findings may have one size: within their intervals, widened by their spread from
    flight to flight.
    """
    apart = abs(a[1] + a[2] - b[1] - b[2]) / 2.0
    half_widths = [(f[2] - f[1]) / 2.0 for f in (a, b)]
    half_widths += [NORMAL_95 * f[4] for f in (a, b)]
    return apart <= float(np.linalg.norm(half_widths))


def read_rows(path: Path) -> list[dict]:
    """Return the rows of a file of ``--json``; bounds that JSON lacks are NaN, as they were."""
    rows = json.loads(path.read_text())["rows"]
    for row in rows:
        gains = row.get("gain", {})
        row["gain"] = {c: [np.nan if x is None else x for x in g] for c, g in gains.items()}
    return rows


def table(rows: Sequence[dict]) -> str:
    """Print the results."""
    lines = []
    for row in sorted(rows, key=lambda row: row["case"]):
        gains = "; ".join(
            f"{c} {100 * g[3]:.0f} % [{100 * g[4]:.0f}, {100 * g[5]:.0f}]"
            for c, g in row.get("gain", {}).items()
        )
        unseen = "; ".join(
            f"{c} {100 * share_removed(e):.0f} %" for c, e in row.get("unseen", {}).items()
        )
        mark = "" if "ok" not in row else "right: " if row["ok"] else "WRONG: "
        lines.append(
            f"{row['case']:44} {mark}{row['overall']};"
            f" {', '.join(row.get('named', ())) or 'nothing'}"
            + (f"; varies: {', '.join(row['varies'])}" if row.get("varies") else "")
            + (f"; held out {gains}" if gains else "")
            + (f"; unseen won back {unseen}" if unseen else "")
        )
    known = [row for row in rows if row["overall"] == result.KNOWN]
    hollow = [
        row["case"]
        for row in known
        if row["gain"] and all(not g[4] > 0.0 for g in row["gain"].values())
    ]
    lines.append(
        f"KNOWN where every interval of the held-out gain includes 0: {', '.join(hollow) or 'none'}"
        f" (of {len(known)})"
    )
    traps = [row for row in rows if "ok" in row]
    lines.append(
        f"traps: {sum(row['ok'] for row in traps)} of {len(traps)} answered with the right reason"
    )
    pairs = agreement([row for row in rows if row.get("of")])
    lines.append(
        f"parts of one vehicle: {sum(p[3] for p in pairs)} of {len(pairs)} pairs of sizes agree"
    )
    lines += [f"  apart: {a} and {b}: {name}" for a, b, name, agrees in pairs if not agrees]
    return "\n".join(lines)


def main() -> None:
    """Run the cases, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the full sets")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", default="", help="cases whose names hold this")
    parser.add_argument("--json", help="write the answers to this file, each as it comes")
    parser.add_argument("--show", help="print the tables of such a file, and run nothing")
    args = parser.parse_args()
    if args.show:
        return print(table(read_rows(Path(args.show))))
    cases = [case for case in (*SETS, *TRAPS, *PARTS) if args.only in case.name]
    rows: list[dict] = []
    for _, row in workers.run_tasks(
        _run_index, [(case.name, args.data) for case in cases], args.jobs
    ):
        rows.append(row)
        print(f"{row['case']}: {row['overall']}", flush=True)
        if args.json:
            write_json(args.json, {"provenance": provenance.collect(), "rows": rows})
    print(table(rows))


def _run_index(task: tuple[str, Path]) -> dict:
    """A case by its name: functions cannot be sent to other processes."""
    name, data = task
    return run((next(case for case in (*SETS, *TRAPS, *PARTS) if case.name == name), data))


if __name__ == "__main__":
    main()
