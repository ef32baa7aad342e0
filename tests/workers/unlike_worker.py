"""Ask for different runs on two ranks: unlike_worker.py SCENE OUT.h5; print each rank's error."""

import sys

from mpi4py import MPI

import msmpetsc
from msmpetsc.errors import InputError

scene, path = sys.argv[1:]
rank = MPI.COMM_WORLD.rank
calls = [
    lambda: msmpetsc.run(scene, path, true_error=1 + rank),
    lambda: msmpetsc.run(scene, path, picture=bool(rank)),
    lambda: msmpetsc.run(scene, path, petsc_options={"ksp_rtol": 0.1 + rank / 10}),
    lambda: list(msmpetsc.frames(scene, 1 + rank)),
    lambda: msmpetsc.run(scene, path, quiet=bool(rank), frames=1),
]
for number, call in enumerate(calls):
    said = "ran"
    try:
        call()
    except InputError as error:
        said = str(error)
    # a single write, so that lines of ranks do not mix
    sys.stdout.write(f"{number} {said}\n")
    sys.stdout.flush()
