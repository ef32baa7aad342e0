"""How long a hierarchy is kept: until what it has cost would have paid for a new one."""

import pytest
from hierarchies import COMM, SHAPES, block
from lattices import cages_of

from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.lattice.lattice import LatticeMaterial, build_lattice
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.nonlinear.preconditioning import WORTH, LatticePreconditioner


@pytest.fixture
def kept(petsc_options):
    """A preconditioner with a hierarchy of the lattice at rest, and another one asked for at turned positions."""
    lattice = build_lattice(cages_of(block(4, 3, 3), 0.1), LatticeMaterial(1000.0, young_modulus=2e5))
    unknowns = Unknowns(COMM, lattice)
    one = LatticePreconditioner(unknowns, Elasticity(lattice), 0.02, "")
    one.prepare(lattice.nodes, None)
    yield one, SHAPES["turned"](lattice.nodes)
    one.destroy()
    unknowns.destroy()


def test_it_is_given_up_when_it_has_cost_as_much_as_a_new_one(kept):
    preconditioner, q = kept
    preconditioner.is_stale = True
    preconditioner.prepare(q, None)
    preconditioner.learn(4, 1e-1)
    for _ in range(int(WORTH / 3)):
        preconditioner.learn(7, 1e-1)
        assert not preconditioner.is_stale
    preconditioner.learn(7, 1e-1)
    assert preconditioner.prepare(q, None) and preconditioner.wasted == 0 and preconditioner.pace is None
