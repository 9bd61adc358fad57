"""``visthrow diagnose map``: propose a mapping of a foreign table's columns as TOML, with questions
where it is uncertain.
"""

import argparse
from pathlib import Path

from visthrow.common.arguments import declare
from visthrow.common.errors import LogError

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Read the file, propose a mapping, print and write it."""
    from visthrow.common.storage import atomic_write
    from visthrow.diagnose.inputs.proposal import propose, propose_model
    from visthrow.logs import read, table_of, takes_mapping

    if takes_mapping(args.file):
        proposal = propose(table_of(args.file), args.file, args.mass, args.time_unit)
    else:
        proposal = propose_model(read(args.file)[0], args.mass)
    text = toml_of(proposal, Path(args.file).name)
    if args.out:
        atomic_write(args.out, text)
    print(text, end="")
    if proposal.mapping is None and proposal.flyer is None:
        raise LogError(f"{args.file}: no mapping proposed; {proposal.questions[-1]}")
    return 0


def toml_of(proposal, name: str) -> str:
    """Return a proposal as the text of a file of ``configs/diagnose``."""
    from visthrow import config
    from visthrow.common import toml_text

    lines = [f"# Proposed for {name}. Answer each question, then remove it."]
    lines += [f"# question: {question}" for question in proposal.questions]
    lines += [f"# left out: {part}" for part in proposal.left_out]
    tree = {"about": name}
    if proposal.mapping is not None:
        tree["table"] = config.to_dict(proposal.mapping, defaults=False)
    if proposal.flyer is not None:
        tree["flyer"] = proposal.flyer
    text = toml_text.dumps(tree)
    for channel, why in proposal.why.items():
        line = f'name = "{channel}"'
        text = text.replace(f"{line}\n", f"{line}  # {why}\n")
    return "\n".join(lines) + f"\n{text}"
