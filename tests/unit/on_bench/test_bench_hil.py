"""What ``bench.runner`` makes of its measurements; and, slow, the measurements themselves
over UDP.
"""

import argparse
import json

from pytest import mark

from bench import faults as hil_faults
from bench import runner
from bench import soak as hil_soak

SOAK_MINUTES = 1.0
MOST_GROWTH = 100e3
"""Of the runner's memory [bytes/s]: 6 MB a minute; a list of every tick's record would grow by
more. A minute is short for a line, the recorder's buffers breathe.
"""


@mark.slow
def test_a_minute_at_200_hz(tmp_path):
    """No tick of ours is missed and memory stays flat; how long a tick takes is for a quiet machine
    to say.
    """
    args = argparse.Namespace(
        minutes=SOAK_MINUTES, rate=200.0, policy="vision", core=None, keep=None, out=str(tmp_path)
    )
    figures = hil_soak.soak(args).figures
    assert figures["ticks"] + figures["missed"] >= 60 * 50 * SOAK_MINUTES
    assert figures["missed_ours"] == 0
    assert figures["breaches"] == []
    if figures["memory_bytes_per_s"] is not None:
        assert abs(figures["memory_bytes_per_s"]) < MOST_GROWTH


TOLD = (
    *(f"{name}{where}" for name in ("ctrl-c", "sigterm", "sighup") for where in ("", "-in-hover")),
    "time-over",
)
"""Ways for a run to end that it hears of."""

ITSELF = {
    "ardupilot": "levelled: no set-points",
    "px4": "left OFFBOARD: no set-points",
    "betaflight": "override: the pilot's sticks count again",
}
"""What each kind does by itself when nobody speaks any more."""

LANDS = {"ardupilot": "mode 9", "px4": "mode 4.6"}

FLOWN_THROUGH = {"none", "clock-forth", "clock-back", "shuffle", "double", "late", "disk-full"}
ENDS = {
    **dict.fromkeys(
        ("stop", "repeat", "swap", "jump", "order", "zero-quaternion", "nan-quaternion"),
        ("recover", "abort"),
    ),
    **dict.fromkeys(("reset", "stuck", "in-progress", "no-answer"), ("recover", "abort")),
    **dict.fromkeys(("payload-lost", "rare"), ("recover",)),
    **dict.fromkeys(
        ("silent", "taken", "not-armed", "no-numbers", "denied", *TOLD, "ctrl-c-twice"), ("abort",)
    ),
    "limits": ("throw",),
    "killed": (),
    "killed-in-hover": (),
    "no-arming": ("ready", "abort"),
    "very-late": (),
    "slow-mechanism": ("refused",),
}
"""By fault what the runner does from then on, in this order, maybe with more between and after."""


@mark.slow
def test_every_fault_over_udp(tmp_path):
    """The same outcomes between two processes as in lock step (tests/loopback); times are the
    machine's.
    """
    out = tmp_path / "faults.json"
    assert runner.main(["--faults", "--speed", "0.5", "--json", str(out)]) == 0
    figures = json.loads(out.read_text())["figures"]
    assert set(figures) == set(hil_faults.known_cases()) == FLOWN_THROUGH | set(ENDS)
    for name, found in figures.items():
        assert found["breaches"] == [], name
        assert (
            found["releases"] <= (name in ("stuck", "in-progress", "denied")) or name == "no-answer"
        ), name
        steps = iter(step["what"].split()[0].rstrip(":") for step in found["states"])
        assert all(wanted in steps for wanted in ENDS.get(name, ())), (name, found["states"])
        case = hil_faults.known_cases()[name]
        if case.since in ("fault", "act"):
            assert found["began_in"] == ("armed" if name.endswith("-in-hover") else "throw"), name
        if name in FLOWN_THROUGH:
            assert found["states"] == [], name
    assert [event["what"] for event in figures["killed"]["events"]] == ["levelled: no set-points"]


@mark.slow
@mark.parametrize("kind", ["ardupilot", "px4", "betaflight"])
def test_every_way_to_end_a_run_over_udp(kind, tmp_path):
    """In hover and in throw: it lands, or does by itself what the table says; the
    summary is there.
    """
    out, names = tmp_path / "faults.json", (*TOLD, "ctrl-c-twice", "killed", "killed-in-hover")
    assert (
        runner.main(["--faults", *names, "--kind", kind, "--speed", "0.5", "--json", str(out)]) == 0
    )
    figures = json.loads(out.read_text())["figures"]
    assert (
        set(figures)
        == set(names)
        == {name for name, case in hil_faults.known_cases().items() if case.ends}
    )
    for name, found in figures.items():
        assert (found["breaches"], found["releases"]) == ([], 0), name
        assert found["summary"] == ("killed" not in name), name
        events = [event["what"] for event in found["events"]]
        if "killed" in name:
            assert ITSELF[kind] in events, name
        elif kind in LANDS:
            assert LANDS[kind] in events, name
        if "killed" not in name:
            assert found["states"][0]["what"].startswith("abort"), name
