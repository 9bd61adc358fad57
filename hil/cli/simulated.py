"""``visthrow hil fake`` and ``direct``: the simulated vehicle over the wire, and without it."""

import argparse
import json
import sys
from pathlib import Path

from hil.cli.flight import key_of, params_of
from hil.fakes.direct import Direct, scored
from hil.fakes.mocap import MocapParams
from hil.fakes.process import VEHICLE_ID, ListeningPort, load_plant, make_fake, read_options, serve
from hil.links.clock import MonotonicClock
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link
from visthrow.onboard.policy import Policy, find_policy


def direct(args: argparse.Namespace) -> int:
    """Throw without a wire; a line of JSON a seed."""
    params = params_of(args)
    policy, mocap = Policy.load(find_policy(params.policy)), MocapParams()
    for seed in args.seeds:
        report = Direct(load_plant(args.plant, params.policy, seed), policy, params, mocap, seed).throw()
        print(json.dumps({"seed": seed, **scored(report, params, report["start"]), **report}), flush=True)
    return 0


def fake(args: argparse.Namespace) -> int:
    """Fly a fake autopilot, and print its report."""
    options = read_options([*args.overrides, f"answer={args.answer}"])
    plant = load_plant(args.plant, args.policy, args.seed)
    link = Link(open_port(check_device(args.device)), *VEHICLE_ID, key=key_of(args))
    port = ListeningPort(args.msp_port) if args.kind == "betaflight" else None
    flown = make_fake(args.kind, plant, link, MocapParams(rate=args.rate), args.seed, options, port)
    print(f"the fake {args.kind} flies", file=sys.stderr, flush=True)
    out = None if args.out is None else Path(args.out)
    print(json.dumps(serve(flown, MonotonicClock(args.speed), args.seconds, out, args.after), indent=2))
    return 0
