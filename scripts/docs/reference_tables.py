"""Tables of the reference pages, each generated from the program's own table.

A page names a table on a line of its own: ``<!-- table: scene_keys -->``.
"""

import re
from collections.abc import Callable, Iterable
from typing import Any

from msmpetsc.app.request import OPTIONS, Option, flag_of
from msmpetsc.cli.command_table import COMMANDS, VERBOSITY, Argument
from msmpetsc.fields import DIMENSIONS, FIELDS
from msmpetsc.scene.key_table import keys
from msmpetsc.scene.schema import OF_REGIONS, SceneFile

MARKER = re.compile(r"^<!-- table: (\w+) -->$", re.MULTILINE)
# tables of a body with the same keys as the scene's tables of these names
SAME_IN_BODY = ("mesh", "start", *OF_REGIONS)
ABOUT = {
    "": "keys of no table",
    "region": f"the region of each {', '.join(OF_REGIONS)}; a pin has no other key",
}


def cell(text: object) -> str:
    """Return a text as the content of a cell: without line ends, with | escaped outside code."""
    parts = " ".join(str(text).split()).split("`")
    parts[::2] = [part.replace("|", "\\|") for part in parts[::2]]
    return "`".join(parts)


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a table in Markdown."""
    names = list(head)
    lines = [names, ["---"] * len(names), *rows]
    return "\n".join(f"| {' | '.join(map(cell, line))} |" for line in lines)


def prose(text: str) -> str:
    """Return a text whose bracketed units do not become links."""
    return text.replace("[", "\\[")


def code(text: str) -> str:
    """Return a text as code; an empty text stays empty."""
    return f"`{text}`" if text else ""


def scene_keys() -> str:
    """Return a section for each table of a scene, with its keys."""
    sections: dict[str, list[tuple[str, ...]]] = {}
    for key in keys():
        name, _, rest = key.name.partition(".")
        if name == "body" and rest.split(".")[1] in SAME_IN_BODY:
            continue
        if ".region." in key.name:
            if name != OF_REGIONS[0]:
                continue
            name = "region"
        shown = key.name.partition(f"{OF_REGIONS[0]}.N.")[2] if name == "region" else key.name
        row = (code(shown), prose(key.default), key.bounds, prose(key.about))
        sections.setdefault(name if rest else "", []).append(row)
    lines = []
    for name, rows in sections.items():
        about = ABOUT.get(name) or str(SceneFile.model_fields[name].description)
        heading = f"## {name}" if name else "## The scene itself"
        sentence = f"{about[:1].upper()}{about[1:].rstrip('.')}."
        if name == "body":
            same = ", ".join(code(each) for each in SAME_IN_BODY)
            sentence += f" Its tables {same} have the keys of the scene's tables of these names."
        lines += [heading, sentence, table(("key", "default", "range", "meaning \\[unit\\]"), rows)]
    return "\n\n".join(lines)


def word_of(argument: Argument) -> str:
    """Return names and value of an argument as a user types them."""
    names, keywords = argument
    value = keywords.get("metavar") or "|".join(keywords.get("choices") or ())
    if not names[0].startswith("-"):
        return str(value or names[0])
    return f"{', '.join(names)} {value}".rstrip()


def row_of(argument: Argument) -> tuple[str, str]:
    """Return the row of an argument in a table of options."""
    about = str(argument[1].get("help", "")).replace("%%", "%")
    return code(word_of(argument)), prose(about)


def options_of_run() -> str:
    """Return the table of options of a run, on the command line and in Python."""
    rows = []
    for name, option in OPTIONS.items():
        rows.append((code(word_of_option(name, option)), code(name), prose(option.help)))
    return table(("option", "keyword in Python", "meaning"), rows)


def word_of_option(name: str, option: Option) -> str:
    """Return an option of a run as a user types it; "" if only Python has it."""
    value = str(option.keywords.get("metavar") or "|".join(option.keywords.get("choices", ())))
    if option.python:
        return ""
    return value if name == "scene" else " ".join([*option.short, flag_of(name), value]).strip()


def commands() -> str:
    """Return a section for each command, with its options and examples."""
    lines = []
    for name, command in COMMANDS.items():
        about = command.description or f"{command.help[:1].upper()}{command.help[1:]}."
        lines += [f"## {name}", about, "```text\n" + "\n".join(command.examples) + "\n```"]
        if command.arguments:
            lines.append(table(("argument", "meaning"), map(row_of, command.arguments)))
    lines += ["## Every command", table(("argument", "meaning"), map(row_of, VERBOSITY))]
    return "\n\n".join(lines)


def fields() -> str:
    """Return the table of datasets of a result file."""
    rows = []
    for name, field in FIELDS.items():
        shape = ", ".join(map(str, field.shape)) + "," * (len(field.shape) == 1)
        rows.append((f"/{name}", field.dtype, f"({shape})", field.unit, field.long_name))
    return table(("dataset", "type", "shape", "unit", "meaning"), rows)


def dimensions() -> str:
    """Return the table of dimension names, as xarray shows them."""
    rows = [(code(str(key)), code(name)) for key, name in DIMENSIONS.items()]
    return table(("letter or length", "dimension"), rows)


def preset_list() -> list[tuple[str, Any]]:
    """Return names and presets; PETSc is imported here, because only these tables need it."""
    from msmpetsc.solve.presets import PRESETS

    return list(PRESETS.items())


def presets() -> str:
    """Return the table of presets."""
    rows = [(code(name), preset.about) for name, preset in preset_list()]
    return table(("preset", "when to use it"), rows)


def preset_options() -> str:
    """Return a section for each preset, with its options of PETSc."""
    lines = []
    for name, preset in preset_list():
        options = "\n".join(f"-{key} {value}".rstrip() for key, value in preset.options.items())
        lines += [f"## {name}", f"{preset.about}.", f"```text\n{options}\n```"]
    return "\n\n".join(lines)


def refused_options() -> str:
    """Return the table of PETSc's options that are refused, with the reason of each."""
    from msmpetsc.solve.refused_options import NO_USE

    # a long expression may wrap behind a bar
    wrapping = {pattern.replace("|", "|\u200b"): reason for pattern, reason in NO_USE.items()}
    rows = [(reason, code(f"-{pattern}")) for pattern, reason in wrapping.items()]
    return table(("reason", "option and value, a regular expression"), rows)


TABLES: dict[str, Callable[[], str]] = {
    function.__name__: function
    for function in (
        scene_keys, options_of_run, commands, fields, dimensions, presets, preset_options,
        refused_options,
    )
}  # fmt: skip


def with_tables(text: str) -> str:
    """Return the text of a page with its tables. Raises KeyError for an unknown table."""
    return MARKER.sub(lambda marker: TABLES[marker[1]](), text)
