"""Stand-in for ``msmpetsc run`` in tests of studies: 8 nodes that swing by a formula.

    study_stand_in.py run SCENE -o OUT.h5 --overwrite --measure M.json --set ... [PETSc options]

Its options decide the outcome. -ksp_fail ends it with an error, -ksp_hang never ends it, and
-ksp_children starts another process first. -ksp_exit N ends it with that status, -ksp_kind K
reports a failed step of that kind. Its wall time counts the runs of the folder, and the error of
its motion is the time step.
"""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from time import sleep
from typing import Any

CALLS = "calls.txt"


def begin(words: list[str]) -> None:
    """Record the call and start the requested work, before slow imports."""
    folder = Path(words[words.index("-o") + 1]).parent.parent
    if os.environ.get("OMPI_COMM_WORLD_RANK", "0") == "0":
        with open(folder / CALLS, "a") as file:
            file.write(" ".join(words) + "\n")
    if "-ksp_children" in words:
        child = subprocess.Popen(["sleep", "60"])
        (folder / "child").write_text(str(child.pid))
    if "-ksp_hang" in words:
        sleep(60)


def stands_in(*case: Any) -> list[str]:
    """Return the command of a case with the stand-in in place of the program."""
    from msmpetsc.study.cases import command

    words = command(*case)
    at = words.index("-m")
    return [*words[:at], __file__, *words[at + 2 :]]


if __name__ == "__main__":
    begin(sys.argv[1:])

import numpy as np  # noqa: E402
from mpi4py import MPI  # noqa: E402

from msmpetsc.errors import InputError  # noqa: E402
from msmpetsc.fields import Frame  # noqa: E402
from msmpetsc.results.writer import Begin, ResultFile  # noqa: E402

NODES = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
MASS = np.arange(1.0, 9.0)


def main() -> None:
    words = sys.argv[1:]
    out, measure = (Path(words[words.index(name) + 1]) for name in ("-o", "--measure"))
    changes = [words[n + 1].partition("=") for n, word in enumerate(words) if word == "--set"]
    values = {key: value for key, _, value in changes}
    time, every = tomllib.loads(f"v = {values['time']}")["v"], int(values.get("output.every", 1))
    comm = MPI.COMM_WORLD
    count = len((out.parent.parent / CALLS).read_text().splitlines()) if comm.rank == 0 else 0
    if "-ksp_fail" in words:
        sys.exit("a note\nmsmpetsc: error: planted, with reason\nafterwards")
    write(comm, out, time, every, count)
    if comm.rank == 0:
        kind = words[words.index("-ksp_kind") + 1] if "-ksp_kind" in words else None
        failure = {"failure": kind and {"kind": kind, "frame": 3, "says": "planted"}}
        measure.write_text(json.dumps(told(comm.size, count) | failure))
    if "-ksp_exit" in words:
        sys.exit(int(words[words.index("-ksp_exit") + 1]))


def write(comm, out: Path, table: dict, every: int, count: int) -> None:
    """Write frames whose error from the exact motion is the time step."""
    step, own = table["step"], slice(None) if comm.rank == 0 else slice(0)
    count_of_frames = round(table["duration"] / step / every) + 1
    with ResultFile(out, comm, {"scene": "", "ranks": comm.size}, Begin.OVERWRITE) as file:
        file.write("lattice/nodes", NODES[own])
        file.write("lattice/mass", MASS[own])
        file.start_frames(count_of_frames, len(NODES[own]))
        for index in range(count_of_frames):
            time = index * step * every
            x = NODES + (1 + step) * time * np.array([0, 0, 1.0])
            solved = dict(step_error=0.01, iterations=3 * every, ksp_its=30 * every)
            place = dict(index=index, time=time, position=x[own])
            file.append(Frame(wall_time=every * step * count, **place, **solved))


def told(ranks: int, count: int) -> dict:
    times = dict.fromkeys(("setup", "factor", "local", "ksp", "output", "stepping"), float(count))
    machine = {"cpu": "a CPU", "cores": 2, "memory": 2**33, "system": "Linux"}
    counts = {"cells": 1, "nodes": 8, "unknowns": 8, "springs": 28, "ranks": ranks}
    counts |= {"memory": 1000 - count}
    return {"machine": machine, "versions": {"msmpetsc": "x"}, "time": times, **counts}


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"msmpetsc: error: {error}")
