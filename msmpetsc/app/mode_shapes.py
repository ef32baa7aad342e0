"""``msmpetsc modes``: natural frequencies and mode shapes, and a result file of the shapes."""

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from msmpetsc.app.request import RunRequest
from msmpetsc.app.start import options_given
from msmpetsc.comm import on_root
from msmpetsc.fields import Frame
from msmpetsc.results.disk import refuse_existing

# for type checkers only: PETSc must get its options before it is imported
if TYPE_CHECKING:
    from msmpetsc.app.running import RunPlan
    from msmpetsc.build import Model
    from msmpetsc.solve.natural_modes import Modes

# largest displacement of a stored shape over the longest side [-]; well visible
AMPLITUDE = 0.1


def find_modes(comm: MPI.Intracomm, request: RunRequest, count: int) -> "Modes":
    """Return the lowest modes of a request's scene; write their shapes if it names an output.

    Collective. Raises InputError or StepFailed.
    """
    with options_given(comm, request):
        from msmpetsc.app.running import described_model, prepare
        from msmpetsc.solve.natural_modes import modes_of

        if request.output:
            on_root(comm, lambda: refuse_existing(request.path, request.overwrite))
        plan = prepare(comm, request, None)
        model = described_model(comm, plan)
        modes = modes_of(comm, plan.scene, model, count)
        if request.output:
            _write(comm, plan, model, modes)
    return modes


def _write(comm: MPI.Intracomm, plan: "RunPlan", model: "Model", modes: "Modes") -> None:
    """Write the base state as frame 0, then a frame for each shape (collective)."""
    from msmpetsc.app.running import open_output, write_companions
    from msmpetsc.lattice.embedded_surface import EmbeddedPoints
    from msmpetsc.results.writer import write_model

    embedding, side = model.embedding, model.lattice.longest_side()
    surface_at = None if embedding is None else EmbeddedPoints(comm, model.lattice, embedding)
    with open_output(comm, plan, {"frequencies": modes.frequencies}) as file:
        write_model(comm, file, model)
        rows = {} if surface_at is None else {"surface": surface_at.weights.shape[0]}
        file.start_frames(1 + len(modes.shapes), model.lattice.owned, rows)
        for index, shape in enumerate([np.zeros_like(modes.position), *modes.shapes]):
            largest = max(comm.allgather(float(np.linalg.norm(shape, axis=1).max(initial=0.0))))
            scale = AMPLITUDE * side / largest if largest else 0.0
            q = modes.position + scale * shape
            surface = surface_at(q) if surface_at else None
            file.append(Frame(index, index, q, surface))
    write_companions(comm, plan.request, whole=False)
