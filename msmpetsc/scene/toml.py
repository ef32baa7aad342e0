"""TOML text of unknown origin -> its data, with the standard library alone."""

import re
import tomllib
from typing import Any

DEEPEST = 50  # parts of a key: tomllib takes time by their square
KEY = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
DEEP_KEY = re.compile(rf"(?:^|[\[{{,])[ \t]*{KEY}(?:[ \t]*\.[ \t]*{KEY}){{{DEEPEST}}}", re.MULTILINE)


def toml_of(text: str) -> dict[str, Any]:
    """Return the data of a TOML text. Raises ValueError for other text, RecursionError for one nested too deeply."""
    if DEEP_KEY.search(text):
        raise RecursionError
    return tomllib.loads(text)
