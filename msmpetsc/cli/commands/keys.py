"""``msmpetsc keys``, ``msmpetsc schema``: print the keys of a scene as a table or JSON schema."""

import argparse
import json

from msmpetsc.scene.key_table import json_schema, keys

HEAD = ("key", "default", "range", "meaning [unit]")


def run(args: argparse.Namespace) -> int:
    """Print a line for each key, or the schema; return the exit status."""
    if args.command == "schema":
        print(json.dumps(json_schema(), indent=1))
        return 0
    rows = [HEAD, *keys(args.table or "")]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)][:-1]
    for *columns, meaning in rows:
        print(
            "  ".join(
                [*(f"{text:{width}}" for text, width in zip(columns, widths, strict=True)), meaning]
            ).rstrip()
        )
    return 0
