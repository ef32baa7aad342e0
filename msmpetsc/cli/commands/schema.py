"""``msmpetsc schema``: the JSON schema of a scene file, for editors."""

import argparse
import json

from msmpetsc.scene.key_table import json_schema


def run(_: argparse.Namespace) -> int:
    """Print the schema; return the exit status."""
    print(json.dumps(json_schema(), indent=1))
    return 0
