"""``visthrow hil replay`` and ``view``: what is done with a run's folder."""

import argparse
from pathlib import Path

from hil.recording.bundle import opened, pack
from hil.recording.playback import replay


def again(args: argparse.Namespace) -> int:
    """Run a recorded run again, and compare; 1 where anything differs or the recording was cut, else 0."""
    with opened(args.folder) as folder:
        found = replay(folder)
    for n, name, was, now in found["differences"][:10]:
        print(f"tick {n}: {name} was {was}, is {now}")
    same = "all bit for bit the same" if not found["differences"] else f"{len(found['differences'])} DIFFERENCES"
    print(f"{found['ticks']} ticks, {found['actions']} actions of the policy: {same}")
    if found["cut"]:
        print(f"CUT: {found['cut']}")
        if Path(args.folder).is_dir():
            print(f"{pack(args.folder)}  what there is of the run, in one file")
    print(found["story"])
    return 1 if found["differences"] or found["cut"] else 0


def view(args: argparse.Namespace) -> int:
    """Look at a run, live or from its folder."""
    from hil.recording.view import run

    return run(Path(args.folder), args.live, args.out, args.web_port, args.data_port)
