"""``msmpetsc`` and ``python -m msmpetsc``."""

import sys

from msmpetsc.errors import InputError, as_expected


def main() -> None:
    """Run the command line; where only results can be read, one line says what a run needs."""
    try:
        from msmpetsc.cli.main import entry_point  # needs what the extra "run" brings

        entry_point()
    except ModuleNotFoundError as error:
        expected = as_expected(error)
        if expected is None:
            raise
        print(f"msmpetsc: error: {expected}", file=sys.stderr)
        sys.exit(InputError.exit_status)


if __name__ == "__main__":
    main()
