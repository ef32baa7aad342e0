"""The bytes that inspect counts, against the arrays of a lattice and of the assembly of its matrix."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene
from mpi4py import MPI

from msmpetsc.build import build_model
from msmpetsc.lattice.lattice import BYTES_OF_CELL, BYTES_OF_NODE, BYTES_OF_SPRING, Lattice, lattice_bytes
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.linear import unknowns as unknowns_module
from msmpetsc.solve.linear.system import assemble, assembly_bytes
from msmpetsc.solve.linear.unknowns import Unknowns

SELF = MPI.COMM_SELF


@pytest.fixture
def lattice(tmp_path: Path) -> Lattice:
    """A block of some 1,800 cells."""
    path = block_scene(tmp_path, time={"step": 0.01, "duration": 0.1}, cages={"count": 1800})
    return build_model(SELF, load_scene(path)).lattice


def test_a_lattice_says_the_bytes_of_its_arrays(lattice: Lattice):
    arrays = {name: value for name, value in vars(lattice).items() if isinstance(value, np.ndarray)}
    del arrays["ghosts"]  # of other ranks: nodes, once more
    del arrays["first_of_body"]  # one number
    arrays["table"] = lattice.table.keys
    counts = (
        (len(lattice.cells), BYTES_OF_CELL),
        (len(lattice.nodes), BYTES_OF_NODE),
        (len(lattice.springs), BYTES_OF_SPRING),
    )
    expected = {name: count * size for count, sizes in counts for name, size in sizes.items()}
    assert {name: array.nbytes for name, array in arrays.items()} == expected
    assert lattice_bytes(*(count for count, _ in counts)) == sum(expected.values())


def test_unknowns_say_the_bytes_of_their_nodes(lattice: Lattice):
    unknowns = Unknowns(SELF, lattice)
    for name, size in unknowns_module.BYTES_OF_NODE.items():
        assert getattr(unknowns, name).nbytes == size * len(lattice.nodes)
    unknowns.destroy()


def test_the_assembly_says_the_bytes_that_it_takes(lattice: Lattice):
    """As Python's own count of memory has it, within a tenth; what PETSc takes for A is not in that."""
    unknowns = Unknowns(SELF, lattice)
    tracemalloc.start()
    matrix = assemble(SELF, unknowns, 0.01)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    nonzeros = unknowns.size + 2 * len(lattice.springs)
    assert assembly_bytes(len(lattice.nodes), len(lattice.springs), nonzeros) == pytest.approx(peak, rel=0.1)
    matrix.destroy()
    unknowns.destroy()
