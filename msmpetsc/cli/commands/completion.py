"""``msmpetsc completion``: the script by which a shell completes the command line."""

import argparse

from msmpetsc.app.checks import checked_file, checked_path
from msmpetsc.cli.arguments import command_parser
from msmpetsc.errors import InputError


def run(args: argparse.Namespace) -> int:
    """Print the script; return the exit status. Raises InputError for a shell that shtab does not know."""
    import shtab  # of the extra "run"

    if args.shell not in shtab.SUPPORTED_SHELLS:
        raise InputError(f"shtab {shtab.__version__} knows no {args.shell}: pip install --upgrade shtab")
    parser = command_parser()
    (commands,) = (action.choices for action in parser._actions if isinstance(action.choices, dict))
    for argument in (each for command in commands.values() for each in command._actions):
        if argument.type in (checked_path, checked_file):  # completed by files
            argument.complete = shtab.FILE
    print(shtab.complete(parser, args.shell))
    return 0
