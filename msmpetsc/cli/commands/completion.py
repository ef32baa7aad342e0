"""``msmpetsc completion``: the script by which a shell completes the command line."""

import argparse
from typing import Any

from msmpetsc.app.checks import checked_file, checked_path
from msmpetsc.cli.arguments import command_parser
from msmpetsc.cli.ranks import world
from msmpetsc.errors import InputError


def run(args: argparse.Namespace) -> int:
    """Print the script; return the exit status. Raises InputError for a shell that shtab does not know."""
    import shtab  # of the extra "run"

    if args.shell not in shtab.SUPPORTED_SHELLS:
        raise InputError(f"shtab {shtab.__version__} knows no {args.shell}: pip install --upgrade shtab")
    parser = command_parser()
    for action in parser._actions:
        for command in (action.choices or {}).values() if isinstance(action.choices, dict) else ():
            complete_files(command, shtab.FILE)
    if world().rank == 0:
        print(shtab.complete(parser, args.shell))
    return 0


def complete_files(parser: argparse.ArgumentParser, by: dict[str, Any]) -> None:
    """Complete each argument that is a path by the files that there are."""
    for action in parser._actions:
        if action.type in (checked_path, checked_file):
            action.complete = by  # type: ignore[attr-defined]  # where shtab looks for it
