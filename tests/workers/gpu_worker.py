"""``msmpetsc`` with these arguments on pretended GPUs."""

import sys

import petsc4py

petsc4py.init([])
from pretend_gpu import pretended  # noqa: E402 (which imports PETSc)

from msmpetsc.cli.main import main  # noqa: E402

with pretended():
    sys.exit(main(sys.argv[1:]))
