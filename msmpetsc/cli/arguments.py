"""What several commands ask of their arguments."""

import argparse

from msmpetsc.errors import InputError


def refuse_below_one(args: argparse.Namespace, *names: str) -> None:
    """Raises InputError for the first of these that is given and below 1."""
    for name in names:
        number = getattr(args, name)
        if number is not None and number < 1:
            raise InputError(f"--{name.replace('_', '-')} must be at least 1, not {number}")
