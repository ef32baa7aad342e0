"""Count each rank's rows of a scene: shares_worker.py SCENE OUT.json [KEY=VALUE ...]"""

import json
import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from msmpetsc.build import build_model
from msmpetsc.scene.reading import load_scene

comm = MPI.COMM_WORLD
lattice = build_model(comm, load_scene(Path(sys.argv[1]), sys.argv[3:])).lattice
inner = int((lattice.springs < lattice.owned).all(axis=1).sum())
own = {
    "cells": len(lattice.cells),
    "nodes": lattice.owned,
    "ghosts": len(lattice.ghosts),
    "springs": len(lattice.springs),
    "cut": len(lattice.springs) - inner,
    "neighbours": len(np.unique(lattice.table.owner_of_index(lattice.ghosts))),
}
told = comm.gather(own)
if comm.rank == 0:
    Path(sys.argv[2]).write_text(json.dumps({name: [one[name] for one in told] for name in own}))
