"""``visthrow config``: print a configuration with all its values filled in."""

import argparse

from visthrow import config
from visthrow.common.arguments import declare
from visthrow.common.errors import ConfigError
from visthrow.config import kinds

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Print the names of a kind, or one resolved config."""
    kind = args.kind
    if kind not in kinds.KINDS:
        kinds.schema_of(kind)
    if args.name is None:
        names = config.available(kind)
        if args.overrides:
            raise ConfigError(f"--set needs the NAME of a config; {kind} has: {', '.join(names)}")
        print("\n".join(names))
        return 0
    path = config.find(kind, args.name)
    resolved = config.load(kinds.schema_of(kind, path.stem), path, args.overrides)
    print(config.dumps(resolved), end="")
    if args.json is not None:
        from visthrow.common.storage import write_json

        write_json(args.json, config.to_dict(resolved))
    return 0
