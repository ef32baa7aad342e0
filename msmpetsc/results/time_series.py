"""Series of a result: a row a frame of energies, forces and places of probes, as text."""

import csv
import io
from collections.abc import Iterator

from msmpetsc.backend.arrays import Floats
from msmpetsc.errors import InputError
from msmpetsc.results.reader import Result
from msmpetsc.scene.bodies import held_by
from msmpetsc.scene.schema import SceneFile

SERIES = (
    "kinetic", "elastic", "potential", "contact", "self_contact", "momentum", "load", "reaction", "push",
    "contact_push", "probe",
)  # fmt: skip


def columns_of(run: Result, scene: SceneFile) -> Iterator[tuple[str, Floats]]:
    """Yield the columns of a result, the time first: name with unit, and a number a frame (T,).

    Raises InputError where they are not those of the scene.
    """
    yield "time [s]", run.frames.time[:]
    names = {
        "reaction": [table.key for table in held_by(scene)],
        "push": [f"obstacle.{number}" for number in range(len(scene.obstacle))],
        "contact_push": [f"body.{number}" for number in range(max(1, len(scene.body)))],
        "probe": [probe.name for probe in scene.output.probe],
    }
    for name in filter(run.frames.__contains__, SERIES):
        array = run.frames[name]
        of_rows = names.get(name, [""])
        if array.ndim == 3 and array.shape[1] != len(of_rows):
            raise InputError(f"{run.path} is damaged: {array.name} has {array.shape[1]} rows for {len(of_rows)} tables")
        axes = ("x", "y", "z") if array.ndim > 1 else ("",)
        values = array[:].reshape(len(array), len(of_rows), len(axes))
        for row, whose in enumerate(of_rows):
            for axis, letter in enumerate(axes):
                words = " ".join(filter(None, [name, whose, letter]))
                yield f"{words} [{array.unit}]", values[:, row, axis]


def series_text(run: Result, scene: SceneFile) -> str:
    """Return the series as CSV: a line of names and units, then one a frame. Raises InputError."""
    columns, text = dict(columns_of(run, scene)), io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))
    return text.getvalue()
