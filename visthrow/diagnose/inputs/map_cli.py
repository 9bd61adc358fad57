"""``visthrow diagnose map``: a proposed mapping of a foreign table's columns, as TOML, with what it
could not know as questions.
"""

import argparse
import json
from pathlib import Path

from visthrow.common.arguments import declared
from visthrow.common.errors import LogError

add_arguments = declared(__file__)


def run(args: argparse.Namespace) -> int:
    """Read, propose, print."""
    from visthrow.common.storage import atomic_write
    from visthrow.diagnose.inputs.proposal import propose
    from visthrow.logs import table_of

    proposal = propose(table_of(args.file), args.file, args.mass, args.time_unit)
    text = toml_of(proposal, Path(args.file).name)
    if args.out:
        atomic_write(args.out, text)
    print(text, end="")
    if proposal.mapping is None:
        raise LogError(f"{args.file}: no mapping proposed; {proposal.questions[-1]}")
    return 0


def toml_of(proposal, name: str) -> str:
    """Return a proposal as the text of a file of ``configs/diagnose``."""
    lines = [f"# Proposed for {name}. Answer each question, then remove it."]
    lines += [f"# question: {question}" for question in proposal.questions]
    lines += [f"# left out: {part}" for part in proposal.left_out]
    lines += [f'about = "{name}"']
    if proposal.mapping is None:
        return "\n".join(lines) + "\n"
    for title, clock in [("time", proposal.mapping.time), *(proposal.mapping.clocks or {}).items()]:
        lines += ["", f"[table.{title}]" if title == "time" else f'[table.clocks."{title}"]']
        lines += [
            f'column = "{clock.column}"' if clock.column else f"row_period = {clock.row_period}"
        ]
        lines += [f'unit = "{clock.unit}"'] if clock.column and clock.unit != "s" else []
    for entry in proposal.mapping.channels:
        listed = ", ".join(f'"{column}"' for column in entry.columns)
        lines += ["", "[[table.channels]]", f'name = "{entry.name}"  # {proposal.why[entry.name]}']
        lines += [f"columns = [{listed}]", f'unit = "{entry.unit}"']
        lines += [f'kind = "{entry.kind}"'] if entry.kind != "vector" else []
        lines += [
            f'{key} = "{value}"'
            for key in ("axes", "body_axes", "frame", "clock")
            if (value := getattr(entry, key))
        ]
        lines += ['order = "wxyz"'] if entry.order != "xyzw" else []
        lines += ["held = true"] if entry.held else []
    for title, table in (
        ("flyer", proposal.flyer or {}),
        ("flyer.cable", (proposal.flyer or {}).get("cable", {})),
    ):
        lines += ["", f"[{title}]"] if table else []
        lines += [
            f"{key} = {json.dumps(value)}"
            for key, value in table.items()
            if not isinstance(value, dict)
        ]
    return "\n".join(lines) + "\n"
