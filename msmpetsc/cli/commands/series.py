"""``msmpetsc series``: write energies, forces and probe positions of a result as CSV."""

import argparse
import csv
import io
import sys
from collections.abc import Iterator

from msmpetsc.backend.arrays import Floats
from msmpetsc.results.disk import refuse_existing, write_whole
from msmpetsc.results.reader import Result
from msmpetsc.results.untrusted_file import plain_damage
from msmpetsc.scene.schema import HOLDERS, SURFACE_LOADS, SceneFile
from msmpetsc.view.drawable import read_scene

SERIES = (
    "kinetic", "elastic", "potential", "contact", "self_contact", "momentum", "load", "reaction",
    "torque", "push", "contact_push", "surface_load", "probe",
)  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Write the series of a result; return the exit status."""
    if args.output:
        refuse_existing(args.output, args.overwrite)
    with plain_damage(args.result), Result(args.result) as result:
        text = series_text(result, read_scene(result))
    if args.output is None:
        sys.stdout.write(text)
        return 0
    write_whole(args.output, text)
    print(args.output)
    return 0


def columns_of(run: Result, scene: SceneFile) -> Iterator[tuple[str, Floats]]:
    """Yield name with unit and values (T,) of each column, the time first."""
    yield "time [s]", run.frames.time[:]
    names = {
        "reaction": [table.key for table in scene.tables(*HOLDERS)],
        "torque": [table.key for table in scene.tables(*HOLDERS)],
        "push": [f"obstacle.{number}" for number in range(len(scene.obstacle))],
        "contact_push": [f"body.{number}" for number in range(max(1, len(scene.body)))],
        "surface_load": [table.key for table in scene.tables(*SURFACE_LOADS)],
        "probe": [probe.name for probe in scene.output.probe],
    }
    for name in filter(run.frames.__contains__, SERIES):
        array = run.frames[name]
        row_names = names.get(name, [""])
        axes = ("x", "y", "z") if array.ndim > 1 else ("",)
        values = array[:].reshape(len(array), len(row_names), len(axes))
        for row, row_name in enumerate(row_names):
            for axis, letter in enumerate(axes):
                words = " ".join(filter(None, [name, row_name, letter]))
                yield f"{words} [{array.unit}]", values[:, row, axis]


def series_text(run: Result, scene: SceneFile) -> str:
    """Return the series as CSV, with a header and a line for each frame. Raises InputError."""
    columns = dict(columns_of(run, scene))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return text.getvalue()
