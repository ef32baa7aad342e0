"""Runs that are killed at random moments, each in a fork of this process, which has loaded all that they need.

kill_worker.py SCENE FOLDER KILLS SEED prints what was seen as JSON. A chain is the same command again and again,
killed, until a run comes to its end; then it is made longer by half, and killed on; then comes another chain.
"""

import json
import os
import random
import signal
import sys
import time
from multiprocessing import Value
from pathlib import Path

import h5py
import numpy as np
import petsc4py

petsc4py.init(["msmpetsc"])

from mpi4py import MPI  # noqa: E402, F401

from msmpetsc.build import build_model  # noqa: E402, F401
from msmpetsc.cli.main import main  # noqa: E402
from msmpetsc.results.reader import finished  # noqa: E402
from msmpetsc.results.writer import ResultFile  # noqa: E402
from msmpetsc.scene.reading import load_scene  # noqa: E402
from msmpetsc.solve.simulate import REMEMBERED, TimeLoop  # noqa: E402, F401

stored = Value("i", 0, lock=False)  # frames that the child's file had when `append` returned
append = ResultFile.append


def told(file: ResultFile, frame) -> None:
    append(file, frame)
    stored.value = file.finished


def start(arguments: list[str]) -> int:
    child = os.fork()
    if child:
        return child
    os.close(2)
    os.open(os.devnull, os.O_WRONLY)
    os._exit(main(arguments))


def run(arguments: list[str], limit: float | None = None) -> int | None:
    """Exit status, None if it was killed after so many seconds."""
    child, end = start(arguments), time.monotonic() + (limit or 60)
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.0005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def kept(frames: int, every: int) -> int:
    """Of so many frames those that a run keeps as it goes on: what comes after its checkpoint it takes again."""
    return (frames - 1) * every // REMEMBERED * REMEMBERED // every + 1 if frames else 0


def fault(path: Path, whole: Path, least: int) -> str | None:
    """What is wrong with a file that should have so many frames at least."""
    if not path.exists():
        return "lost" if least else None
    try:
        with h5py.File(path, locking=False) as file, h5py.File(whole) as other:
            count = finished(file)
            if count < least:
                return f"{least} frames were there, now {count}"
            for name in file["frames"].keys() - {"wall_time"}:
                if not np.array_equal(file["frames"][name][:count], other["frames"][name][:count], equal_nan=True):
                    return f"another {name}"
    except OSError as error:
        return f"corrupt: {error}"
    return None


def chain(
    scene: str, path: Path, kills: int, chance: random.Random, seen: dict, runs: list[tuple[list[str], Path]]
) -> int:
    """Kill the runs in turn until all are at their end, or so many are killed; returns how many were."""
    stored.value, begun = 0, seen["kills"]
    for extra, whole in runs:
        arguments, status = ["run", scene, "--resume", str(path), *extra], None
        while status is None:
            often = chance.choice([[], ["--checkpoint-every", "1"]])
            enough = seen["kills"] - begun >= kills
            status = run([*arguments, *often], None if enough else chance.uniform(0, 1.5 * seen["seconds"]))
            if status is None:
                seen["kills"] += 1
                seen["before the file"] += not path.exists()
                seen["at frame"].append(stored.value)
            wrong = fault(path, whole, kept(stored.value, every))
            if wrong or status:
                seen["faults"].append(f"after {seen['kills']} kills: {wrong or status}")
        if finished(h5py.File(path, locking=False)) != finished(h5py.File(whole)):
            seen["faults"].append("not all frames")
    seen["chains"] += 1
    return seen["kills"] - begun


if __name__ == "__main__":
    scene, folder, kills, seed = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    ResultFile.append, chance = told, random.Random(seed)
    seen = {"kills": 0, "chains": 0, "before the file": 0, "at frame": [], "faults": []}
    duration, every = load_scene(scene).time.duration, load_scene(scene).output.every
    longer = ["--force", "--set", f"time.duration={1.5 * duration}"]
    whole, whole_longer = folder / "whole.h5", folder / "longer.h5"
    assert run(["run", scene, "-o", str(whole)]) == 0 and run(["run", scene, "-o", str(whole_longer), *longer[1:]]) == 0
    begin = time.monotonic()
    assert run(["run", scene, "-o", str(folder / "timed.h5")]) == 0
    seen["seconds"] = time.monotonic() - begin
    while seen["kills"] < kills:  # in several chains: one may be killed again and again where it stands
        path = folder / f"{seen['chains']}.h5"
        chain(scene, path, min(10, kills - seen["kills"]), chance, seen, [([], whole), (longer, whole_longer)])
    print(json.dumps(seen))
