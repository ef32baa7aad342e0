"""Opens copies of a result with bytes overwritten, for test_open.py: open_worker.py RESULT COPY TRIALS."""

import os
import random
import resource
import sys
import traceback
from pathlib import Path

import msmpetsc
import msmpetsc.results.reader  # before the children, or each would import it
from msmpetsc.errors import InputError


def spoilt(data: bytes, chance: random.Random) -> bytes:
    """A few bytes anew, mostly among the metadata at the start."""
    new = bytearray(data)
    for _ in range(chance.choice((1, 2, 8, 64))):
        end = len(new) if chance.random() < 0.3 else len(new) // 3
        new[chance.randrange(end)] = chance.choice((0, 255, chance.randrange(256)))
    return bytes(new)


def read_all(path: Path) -> None:
    with msmpetsc.open(path) as run:
        for group in (run.lattice, run.surface, run.frames):
            for array in group.values():
                array[:]
        for name in ("embedding", "scene"):
            getattr(run, name)


def outcome(path: Path) -> int:
    """0: read, 1: refused in one line, 2: anything else. In a child process, which the HDF5 library may kill."""
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (2, 2))  # HDF5 may run in circles
        status = 2
        try:
            read_all(path)
            status = 0
        except InputError as error:
            status = 2 if "\n" in str(error) else 1
        except Exception:
            traceback.print_exc()
        os._exit(status)
    ended = os.waitpid(child, 0)[1]
    return 3 if os.WIFSIGNALED(ended) else os.WEXITSTATUS(ended)


def main(source: str, copy: str, trials: str, seed: str = "1") -> None:
    resource.setrlimit(resource.RLIMIT_AS, (4 * 2**30, 4 * 2**30))
    data, chance, counts = Path(source).read_bytes(), random.Random(int(seed)), [0, 0, 0, 0]
    for _ in range(int(trials)):
        Path(copy).write_bytes(spoilt(data, chance))
        counts[outcome(Path(copy))] += 1
    print(*counts)  # read, refused, anything else, died


if __name__ == "__main__":
    main(*sys.argv[1:])
