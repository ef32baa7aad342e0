"""The parts of a result file that do not change with time."""

import numpy as np
from mpi4py import MPI

from msmpetsc.build import Model
from msmpetsc.geometry.surface import Surface, joined
from msmpetsc.results.writer import ResultFile

NOTHING = Surface(np.empty((0, 3)), np.empty((0, 3), np.int64))  # what ranks but the first have of surfaces


def write_model(comm: MPI.Intracomm, file: ResultFile, model: Model) -> None:
    """Write the parts of the file that do not change with time (collective)."""
    lattice, owned = model.lattice, model.lattice.owned
    springs = slice(lattice.springs_owned)
    numbers = lattice.global_numbers
    file.write("lattice/nodes", lattice.nodes[:owned])
    file.write("lattice/cells", lattice.cells)
    file.write("lattice/cell_kind", lattice.cell_kind)
    file.write("lattice/cell_share", lattice.cell_share)
    file.write("lattice/springs", numbers[lattice.springs[springs]])
    file.write("lattice/rest_length", lattice.rest_length[springs])
    file.write("lattice/stiffness", lattice.stiffness[springs])
    file.write("lattice/mass", lattice.mass)
    file.write("lattice/pinned", numbers[:owned][lattice.pinned[:owned]])
    several = len(model.bodies) > 1
    if several:
        file.write("lattice/body", lattice.body[:owned].astype("i4"))
    if comm.bcast(bool(model.solids)):  # all of them on rank 0
        solids = joined([*model.solids.values()]) or NOTHING
        counts = [len(solid.triangles) for solid in model.solids.values()]
        file.write("obstacle/points", solids.points)
        file.write("obstacle/triangles", solids.triangles)
        file.write("obstacle/number", np.repeat(np.array([*model.solids], "i4"), counts))
    surface, embedding = model.surface or NOTHING, model.embedding
    if embedding is None:
        return
    if several:
        file.write("surface/body", model.body_of_point.astype("i4"))
    file.write("surface/points", surface.points)
    file.write("surface/triangles", surface.triangles)
    offset = comm.exscan(len(embedding.indices)) or 0
    indptr = embedding.indptr[1:] + offset
    file.write("embedding/indptr", np.append(0, indptr) if comm.rank == 0 else indptr)
    file.write("embedding/indices", embedding.indices)
    file.write("embedding/weights", embedding.weights)
