"""The fake autopilot's process: a fake around an injected plant, flown in real time."""

import contextlib
import inspect
import json
import math
import signal
from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from hil.control.realtime import pause_garbage_collection
from hil.errors import RunError
from hil.links.clock import Clock
from hil.rehearsal.fake import Fake, WirePlant
from visthrow.common.arguments import StopRequest
from visthrow.common.errors import suggest

FAKES = {"ardupilot": "hil.rehearsal.fake_ardupilot:FakeArduPilot"}
# the process ends this long after the payload has landed [s]: the vehicle has landed by then
AFTER_LANDING = 10.0


def load_plant(target: str, policy: str, seed: int, changes: Sequence[str] = ()) -> WirePlant:
    """Call ``module:function`` with policy and seed, and with changes of the policy's configuration
    where there are any; raises `RunError` for a function that does not exist or takes other
    arguments.
    """
    arguments = (policy, seed, *([changes] if changes else []))
    try:
        make = resolve_name(target)
        inspect.signature(make).bind(*arguments)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise RunError(
            f"plant '{target}': {error}; expected module:function, as"
            " visthrow.throws.wire_plant:make, called with policy and seed"
        ) from error
    return make(*arguments)


def load_fake(kind: str) -> type[Fake]:
    """Return the class of a fake: of :data:`FAKES`, or any that is given as ``module:class``.

    Raises `RunError`: no such class.
    """
    target = FAKES.get(kind, kind)
    if ":" not in target:
        raise RunError(f"fake of kind '{kind}'; {suggest(kind, FAKES)}, or module:class")
    try:
        return resolve_name(target)
    except (ImportError, AttributeError, ValueError) as error:
        raise RunError(f"fake of kind '{kind}': {error}; expected module:class") from error


def serve(fake: Fake, clock: Clock, limit: float, out: Path | None, after: float) -> dict[str, Any]:
    """Fly in real time, or on a firmware's clock, until ``after`` seconds after the landing, for
    ``limit`` seconds, or until Ctrl-C; returns the report.
    """
    plant = fake.plant
    begun = fake.plant.time
    late = 0
    # if the machine is late, the vehicle's clock is late by the same time
    start = clock.now() - begun
    heard: list[tuple[float, float]] = []  # first and last period on a firmware's clock
    fake.wall = lambda: plant.time + min(max(clock.now() - start - plant.time, 0.0), plant.period)
    fake.question_lag = 0.0
    interrupt = StopRequest((signal.SIGINT,))
    # a full garbage collection takes a tenth of a second
    with contextlib.suppress(KeyboardInterrupt), interrupt as stop, pause_garbage_collection():
        while plant.time - begun < limit and not stop.asked:
            time = plant.time + plant.period
            due = start + time
            if fake.paced:
                start = clock.now() - plant.time
                due = -math.inf
                heard = [*heard[:1], (clock.now(), plant.time)]
            late += math.isfinite(due) and clock.now() > due
            while clock.now() < due:  # messages act from their arrival
                clock.wait_for([fake.port], due)
                fake.hear()
            fake.deliver(time)  # poses are sent before a period is computed
            fake.step()
            landed = plant.landing["landing_time"]
            if landed is not None and plant.time > landed + after:
                break
    report = {**fake.report(), "late_periods": late}
    if len(heard) > 1:
        (begin, first), (end, last) = heard
        report["speed"] = (last - first) / max(end - begin, 1e-9)
    if out is not None:
        out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return report
