"""What a case changes in its scene file, as --set takes it, and what the file and its changes amount to."""

import json
from pathlib import Path
from typing import Any

from msmpetsc.scene.schema import Scene
from msmpetsc.study.case import Case, digest


def content(file: Path, scene: Scene) -> str:
    """Digest of a scene file and of the files that it names."""
    return digest(file, [name for _, name in scene.named_files()])


def time_changes(case: Case, duration: float, every: int, scene: Scene) -> tuple[str, ...]:
    """Overrides of the time and output tables."""
    time = scene.time.model_dump(exclude_unset=True) | {"step": case.time_step, "duration": duration}
    named = None if case.integrator == "implicit-euler" else case.integrator
    time |= {"integrator": named, "substep": case.substep}
    output = ("output.surface=false", *((f"output.every={every}",) if every > 1 else ()))
    return f"time={inline(time)}", *output


def solver_changes(case: Case, scene: Scene) -> tuple[str, ...]:
    """Overrides of the solver table; none for verlet."""
    if case.integrator == "verlet":
        return ()
    solver = scene.solver.model_dump(exclude_unset=True)
    solver |= {"preset": case.preset, "error": case.error, "max_iterations": case.max_iterations}
    return (f"solver={inline(solver)}",)


def inline(table: dict[str, Any]) -> str:
    """A TOML inline table of plain values; None is left out."""
    return "{" + ", ".join(f"{key} = {json.dumps(value)}" for key, value in table.items() if value is not None) + "}"
