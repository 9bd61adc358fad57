"""View of a run in the rerun viewer, live or from its folder.

The live view reads the run's folder in a separate process and adds no work to the flying one. If
the viewer falls behind, ticks are left out.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Generator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from hil.control.recording.flightlogs import TickLogger, events, read
from hil.control.recording.playback import Playback, Tick
from hil.control.recording.record import (
    CONFIG,
    FORMER_POSES,
    POLICY,
    PROVENANCE,
    SUMMARY,
    TICKS,
    load_setup,
    require_run,
    restore_poses,
)
from hil.errors import RunError
from hil.poses.pose import PAYLOAD, VEHICLE

ENDINGS = (".rrd", ".mcap")  # of recordings: for rerun, for Foxglove
POLL_INTERVAL = 0.1  # between two reads of the folder [s]
MOST_SHOWN = 100  # most ticks sent at a time: if the viewer falls behind, only the last ones
TRAIL = 300  # poses in a drawn trail: three seconds at 100 Hz

BODY_CHANNELS = {VEHICLE: "pos_w", PAYLOAD: "payload_pos_w"}


class Show:
    """Sends ticks to a rerun stream."""

    def __init__(self, stream: Any, playback: Playback, provenance: dict[str, Any], start: float):
        """Send the static parts; ``start`` is the zero of the viewer's time [s]."""
        from visthrow.view import rerun_view

        self._stream = stream
        self._view = rerun_view
        self._start = start
        self._samples = TickLogger(playback, provenance, start)
        self._trails: dict[str, deque] = {name: deque(maxlen=TRAIL) for name in BODY_CHANNELS}
        self._said: list | None = None
        rerun_view.draw_still_parts(
            stream, self._samples.recorder.meta["goal_w"], sizes(playback.runner.pilot)
        )

    def take(self, ticks: list[Tick]) -> None:
        """Send ticks in their order."""
        for tick in ticks:
            self._samples.add(tick)
            for sample in tick.samples:
                if sample.body in self._trails:
                    self._trails[sample.body].append(sample.pose.pos)
        log = self._samples.flush()
        phases = events(ticks)
        if phases and self._said is not None and phases[0][1:] == self._said[1:]:
            phases = phases[1:]
        self._said = phases[-1] if phases else self._said
        log.meta["events"] = phases
        self._view.send(self._stream, log)
        time = ticks[-1].line["time"] - self._start
        for body, points in self._trails.items():
            if len(points) > 1:
                self._view.trail(self._stream, BODY_CHANNELS[body], time, np.array(points))


def sizes(pilot: Any) -> SimpleNamespace:
    """Return the sizes that `visthrow.view.rerun_view` draws, from the policy's contract."""
    contract = pilot.policy.contract
    rotors = SimpleNamespace(**contract["vehicle"]["rotors"])
    rope = SimpleNamespace(payload_radius=contract["rope"]["payload_radius"])
    return SimpleNamespace(
        camera=pilot.camera.params, vehicle=SimpleNamespace(rotors=rotors), rope=rope
    )


def tail(path: Path) -> Generator[list[Any], None, None]:
    """Yield at each step the values of the lines completed since the last step; the file may not
    exist yet.
    """
    while not path.is_file():
        yield []
    with path.open(encoding="utf-8") as file:
        partial = ""
        while True:
            *whole, partial = (partial + file.read()).split("\n")
            yield [json.loads(row) for row in whole]


def follow(folder: str | Path, stream: Any, going: Callable[[], bool] = lambda: True) -> int:
    """Send a run to a rerun stream while it is written, until it is over; return the number of
    ticks left out.
    """
    folder = Path(folder)
    require_run(folder, (CONFIG, POLICY, PROVENANCE))
    if (folder / FORMER_POSES).is_file():
        raise RunError(f"{folder} holds its poses apart, as only former runs do; leave out --live")
    playback = Playback(*load_setup(folder))
    provenance = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
    lines = tail(folder / TICKS)
    show = None
    dropped = 0
    try:
        while going():
            finished = (folder / SUMMARY).is_file()
            ticks = [playback.feed(restore_poses(line)) for line in next(lines)]
            dropped += max(0, len(ticks) - MOST_SHOWN)
            if ticks:
                if show is None:
                    show = Show(stream, playback, provenance, ticks[0].line["time"])
                show.take(ticks[-MOST_SHOWN:])
            elif finished:
                break
            time.sleep(POLL_INTERVAL)
    finally:
        lines.close()
    return dropped


def write(folder: str | Path, path: str | Path) -> None:
    """Write a whole run as a ``.rrd`` or ``.mcap`` file. Raises the errors of :func:`read`, and
    one if the file cannot be written or a package is missing.
    """
    from visthrow.view import mcap_view, rerun_view

    played = read(folder)
    run = played.playback, played.provenance, played.ticks[0].line["time"]
    if Path(path).suffix == ".mcap":
        samples = TickLogger(*run)
        for tick in played.ticks:
            samples.add(tick)
        log = samples.flush()
        log.meta["events"] = events(played.ticks)
        mcap_view.write(path, log, sizes(played.playback.runner.pilot))
        return
    layout = rerun_view.blueprint(np.array(played.playback.params.goal_w), {"state"})
    with rerun_view.open_recording(path, layout) as stream:
        show = Show(stream, *run)
        for first in range(0, len(played.ticks), MOST_SHOWN // 10):
            show.take(played.ticks[first : first + MOST_SHOWN // 10])


def start_viewer(folder: Path) -> subprocess.Popen:
    """Start the live view of a run in a separate process at the lowest priority."""
    command = [sys.executable, "-m", "visthrow.cli", "hil", "view", str(folder), "--live"]
    lowest = (lambda: os.nice(19)) if hasattr(os, "nice") else None
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, preexec_fn=lowest)


def run(args: argparse.Namespace) -> int:
    """Serve the live view or write the files of ``visthrow hil view``."""
    from hil.control.recording.run_report import finish

    folder = Path(args.folder)
    if args.live:
        from visthrow.view import rerun_view
        from visthrow.view.live import web_viewer

        require_run(folder, (CONFIG, POLICY))
        layout = rerun_view.blueprint(np.array(load_setup(folder)[0].goal_w), {"state"})
        with web_viewer(layout, args.web_port, args.data_port) as stream:
            dropped = follow(folder, stream)
            print(
                f"the run is over; {dropped} ticks were left out of the view. Ctrl-C closes the"
                " viewer",
                file=sys.stderr,
            )
            while True:
                time.sleep(1.0)
    path = Path(args.out) if args.out is not None else folder / "run.rrd"
    if path.suffix not in ENDINGS:
        raise RunError(f"--out {path}; expected a recording that ends in {' or '.join(ENDINGS)}")
    write(folder, path)
    opens = "with Foxglove" if path.suffix == ".mcap" else f"with: rerun {path}"
    print(f"{path}  the run in 3D, image plane and signals; open it {opens}")
    print("\n".join(finish(folder)))
    return 0
