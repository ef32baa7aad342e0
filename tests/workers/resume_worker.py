"""Damaged copies of a result, each given to run --resume in a fork: resume_worker.py RESULT COPY TRIALS SEED prints how
many went on, were refused, failed in a step; and what else was seen."""

import io
import os
import random
import re
import resource
import sys
from contextlib import redirect_stderr
from pathlib import Path

import h5py
import numpy as np
import petsc4py

petsc4py.init(["msmpetsc"])

from msmpetsc.cli.main import main  # noqa: E402
from msmpetsc.results.xdmf import write_xdmf  # noqa: E402, F401
from msmpetsc.solve.simulate import Simulation  # noqa: E402, F401

KINDS = ["f8", "f4", ">f8", "i8", "u1", "S3", "c16", h5py.string_dtype(), h5py.vlen_dtype("f8"), h5py.ref_dtype]
SHAPES = [
    (),
    (0,),
    (1,),
    (2,),
    (3,),
    (2, 3),
    (75, 3),
    (2, 75),
    (2, 75, 3),
    (2, 75, 4),
    (1, 75, 3),
    (10**12,),
    (2, 10**9, 3),
]
VALUES = [np.nan, np.inf, -np.inf, -1.0, -1e9, 0.0, 0.5, 1.0, 3.0, 12.0, 1e9, 1e300]
TEXTS = [
    "",
    "x",
    "-",
    "-snes_type",
    "-ksp_rtol 1e-2",
    "\x1b[31m\n",
    "a" * 10**5,
    "9" * 5000,
    "é\u2028",
    "[time]\nstep = nan\n",
]
ANYTHING = [7, -1, 2.5, np.nan, 2**63, np.arange(3), np.array([b"x"]), h5py.Empty("f8"), "", *TEXTS]
MORE = [
    [],
    [],
    ["--force"],
    ["--force", "--set", "time.duration=0.1"],
    ["--force", "--preset", "lbfgs"],
]


def damage(file: h5py.File, chance: random.Random) -> str:
    """One more of it, and what it is."""
    names: list[str] = []
    file.visit(names.append)
    name, kind = chance.choice(names), chance.choice(list(WAYS))
    WAYS[kind](file, name, chance)
    return f"{kind} {name}"


def number(file: h5py.File, name: str, chance: random.Random) -> None:
    if isinstance(file[name], h5py.Dataset) and file[name].size and file[name].dtype.kind in "iuf":
        rows = file[name][...]
        with np.errstate(all="ignore"):
            rows.flat[chance.randrange(rows.size)] = np.array(chance.choice(VALUES)).astype(rows.dtype)
        file[name][...] = rows


def checkpoint_number(file: h5py.File, _: str, chance: random.Random) -> None:
    """Of the newest checkpoint: what the run goes on from."""
    if isinstance(file.get("checkpoint/numbers"), h5py.Dataset) and file["checkpoint/numbers"].ndim == 2:
        numbers, slot = file["checkpoint/numbers"], int(np.argmax(file["checkpoint/step"]))
        numbers[slot, chance.randrange(numbers.shape[1])] = chance.choice(VALUES)


def replace(file: h5py.File, name: str, by) -> None:
    del file[name]
    file[name] = by


def dataset(file: h5py.File, name: str, chance: random.Random) -> None:
    shape = (
        file[name].shape if isinstance(file[name], h5py.Dataset) and chance.random() < 0.5 else chance.choice(SHAPES)
    )
    del file[name]
    chunks = True if shape and all(shape) and chance.random() < 0.7 else None
    packed = {"compression": "gzip"} if chunks and chance.random() < 0.3 else {}
    file.create_dataset(name, shape, chance.choice(KINDS), chunks=chunks, **packed)


def group(file: h5py.File, name: str, _) -> None:
    del file[name]
    file.create_group(name)


def attribute(file: h5py.File, _: str, chance: random.Random) -> None:
    file.attrs[chance.choice(list(file.attrs) or ["x"])] = chance.choice(ANYTHING)


def names(file: h5py.File, _: str, chance: random.Random) -> None:
    if "checkpoint/numbers" in file:
        words = str(file["checkpoint/numbers"].attrs.get("names", "")).split()
        chance.shuffle(words)
        file["checkpoint/numbers"].attrs["names"] = chance.choice(
            [*ANYTHING, " ".join(words), " ".join(words[1:]), "a " * len(words)]
        )


def swap(file: h5py.File, name: str, chance: random.Random) -> None:
    """What another name has stands here."""
    there: list[str] = []
    file.visit(there.append)
    other = chance.choice(there)
    if not other.startswith(f"{name}/") and other != name and not name.startswith(f"{other}/"):
        replace(file, name, file[other])


WAYS = {
    "number": number,
    "checkpoint number": checkpoint_number,
    "dataset": dataset,
    "group": group,
    "missing": lambda file, name, _: file.pop(name),
    "dangling": lambda file, name, _: replace(file, name, h5py.SoftLink("/nowhere")),
    "loop": lambda file, name, _: replace(file, name, h5py.SoftLink(f"/{name}")),
    "link": lambda file, name, _: replace(file, name, h5py.SoftLink("/lattice/nodes")),
    "external": lambda file, name, _: replace(file, name, h5py.ExternalLink("nowhere.h5", "/x")),
    "attribute": attribute,
    "names": names,
    "swap": swap,
}


def trial(source: Path, path: Path, chance: random.Random) -> tuple[str, list[str], int, str]:
    path.write_bytes(source.read_bytes())
    done = []
    with h5py.File(path, "r+") as file:
        for _ in range(chance.choice([1, 1, 1, 2, 3])):
            try:
                done.append(damage(file, chance))
            except (
                KeyError,
                ValueError,
                OSError,
                RuntimeError,
                IndexError,
                TypeError,
                OverflowError,
            ):  # a link that leads nowhere by now
                continue
    given, ends = chance.choice(MORE), os.pipe()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (20, 20))
        told = io.StringIO()
        with redirect_stderr(told):
            status = main(["run", "--resume", str(path), *given])
        os.write(ends[1], told.getvalue()[-3000:].encode(errors="replace"))
        os._exit(status)
    os.close(ends[1])
    with os.fdopen(ends[0], "rb") as pipe:
        told = pipe.read().decode(errors="replace")
    return "; ".join(done), given, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), told


def fault(status: int, told: str) -> bool:
    errors = [line for line in told.split("\n") if "msmpetsc: error" in line]
    fine = status in (0, 2, 3) and (status == 0) == (not errors) and all(line.isprintable() for line in errors)
    return not fine or any(re.search("Error|Traceback|object has no", line) for line in errors)


if __name__ == "__main__":
    source, path, trials, seed = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    counts, faults = {0: 0, 2: 0, 3: 0}, 0
    for index in range(trials):
        chance = random.Random(f"{seed} {index}")
        what, given, status, told = trial(source, path, chance)
        counts[status] = counts.get(status, 0) + 1
        if fault(status, told):
            faults += 1
            print(index, what, given, status, told[-600:], sep="\n  ", flush=True)
    print(counts, "faults:", faults)
