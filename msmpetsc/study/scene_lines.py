"""A method as lines of a scene file, to paste or to put into the file as its author wrote it."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import tomlkit

from msmpetsc.results.disk import write_whole
from msmpetsc.scene.reading import read_toml
from msmpetsc.scene.statics import STATIC
from msmpetsc.study.cases import inline, scene_tables
from msmpetsc.study.sizing.choice import Candidate

Tables = Mapping[str, Mapping[str, Any]]  # of a scene file, by name and key


def tables(method: Candidate, more: Tables = MappingProxyType({})) -> Tables:
    """Return what the method says of a scene, and ``more`` tables; None: the key must not stand there."""
    values = {
        "integrator": method.integrator, "time_step": method.time_step, "substep": None, "preset": method.preset,
        "error": method.step_error, "max_iterations": None,
    }  # fmt: skip
    if method.integrator == STATIC:
        del values["time_step"]  # which spaces states, and need not stand there
    return {**scene_tables(values), **more}


def lines(method: Candidate, more: Tables = MappingProxyType({})) -> str:
    """Return TOML lines to paste."""
    shown = {
        name: {key: value for key, value in table.items() if value is not None}
        for name, table in tables(method, more).items()
    }
    return tomlkit.dumps(shown).strip()


def overrides(scene: Path, method: Candidate, more: Tables = MappingProxyType({})) -> list[str]:
    """Return the same as changes of the scene file, as --set takes them. Raises InputError for a file not TOML."""
    (_, document), changes = read_toml(scene), []
    for name, table in tables(method, more).items():
        given = document.get(name, {})
        if any(value is None and key in given for key, value in table.items()):
            changes.append(f"{name}={inline({**given, **table})}")  # --set changes keys, and takes none away
        else:
            changes += [f"{name}.{key}={value}" for key, value in table.items() if value is not None]
    return changes


def put_into(scene: Path, method: Candidate, more: Tables = MappingProxyType({})) -> None:
    """Change the scene file; comments, order and all else stay as they are. Raises InputError."""
    text = scene.read_bytes().decode()
    line_end = "\r\n" if "\r\n" in text else "\n"
    document = tomlkit.parse(text)
    for name, table in tables(method, more).items():
        if name not in document:
            document[name] = tomlkit.table()
        old: Any = document[name]
        for key, value in table.items():
            if value is None:
                old.pop(key, None)
            elif old.get(key) != value:
                old[key] = value
    # new lines end like the others
    write_whole(scene, tomlkit.dumps(document).replace("\r\n", "\n").replace("\n", line_end))
