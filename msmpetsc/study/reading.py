"""Study file (TOML) -> a checked Study."""

from collections.abc import Collection
from pathlib import Path

from pydantic import ValidationError

from msmpetsc.errors import InputError
from msmpetsc.scene.problems import problem_lines
from msmpetsc.scene.reading import read_toml
from msmpetsc.study.schema import Study


def load_study(path: Path, presets: Collection[str] | None = None) -> Study:
    """Read and check a study file; ``presets`` are the names known, any will do if None.

    Raises InputError naming every problem, one a line.
    """
    text, data = read_toml(path, "study")
    try:
        return Study.model_validate(data, context={"presets": presets})
    except ValidationError as error:
        raise InputError("\n".join(problem_lines(path, error, text, {}))) from None
