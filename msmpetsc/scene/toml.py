"""Text to TOML data, guarded against what takes for ever to parse; without the packages that check a scene."""

import re
import tomllib
from typing import Any

DEEPEST = 50  # parts of a key: tomllib takes time by their square
KEY = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
DEEP_KEY = re.compile(rf"(?:^|[\[{{,])[ \t]*{KEY}(?:[ \t]*\.[ \t]*{KEY}){{{DEEPEST}}}", re.MULTILINE)


def toml_of(text: str) -> dict[str, Any]:
    """Return the text's data. Raises ValueError for what is not TOML, RecursionError for what is nested too deeply."""
    if DEEP_KEY.search(text):
        raise RecursionError
    return tomllib.loads(text)
