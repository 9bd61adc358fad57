"""``visthrow config``: print a configuration with all its values filled in."""

import argparse

from visthrow import config
from visthrow.common.arguments import add_common
from visthrow.common.errors import ConfigError
from visthrow.config import kinds


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = (
        "examples:\n"
        "  visthrow config vehicle                        the names of the shipped vehicles\n"
        "  visthrow config vehicle paper                  all values of one of them\n"
        "  visthrow config vehicle mine.toml              check a file of your own\n"
        "  visthrow config vehicle paper --set body.mass=0.25\n"
    )
    parser.add_argument(
        "kind", metavar="KIND", help=f"what to configure: {', '.join(_kind_names())}"
    )
    parser.add_argument(
        "name",
        metavar="NAME",
        nargs="?",
        help="a shipped name or a TOML file; without it, list the names",
    )
    add_common(parser, device=False, json=True)


def run(args: argparse.Namespace) -> int:
    """Print the names of a kind, or one resolved config."""
    if args.kind not in _kind_names():
        kinds.schema_of(args.kind)
    if args.name is None:
        names = config.available(args.kind)
        if args.overrides:
            raise ConfigError(
                f"--set needs the NAME of a config; {args.kind} has: {', '.join(names)}"
            )
        print("\n".join(names))
        return 0
    path = config.find(args.kind, args.name)
    resolved = config.load(kinds.schema_of(args.kind, path.stem), path, args.overrides)
    print(config.dumps(resolved), end="")
    if args.json is not None:
        from visthrow.common.storage import write_json

        write_json(args.json, config.to_dict(resolved))
    return 0


def _kind_names() -> list[str]:
    return [key for key in kinds.SCHEMAS if "/" not in key]
