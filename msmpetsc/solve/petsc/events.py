"""Events and stages of a run for -log_view.

An event includes the time of events nested in it, as PETSc's events do: KSPSolve includes its
products. For the levels of multigrid, see -pc_mg_log.
"""

from contextlib import ExitStack

from petsc4py import PETSc

SETUP, STEPS, OUTPUT = (PETSc.Log.Stage(name) for name in ("set-up", "steps", "output"))
# reference solves for true errors; the times of the run leave them out
REFERENCE = PETSc.Log.Stage("reference")
# -log_view calls an unused visible stage Unknown; PCMPI is PETSc's own stage
for unused in REFERENCE, PETSc.Log.Stage("PCMPI"):
    unused.visible = False
# stages of a run; 0 is PETSc's main stage, before the set-up and after the last frame
OF_THE_RUN = (0, SETUP.id, STEPS.id, OUTPUT.id)

GRADIENT = PETSc.Log.Event("msmpetsc gradient")
# differences of g
ENERGY = PETSc.Log.Event("msmpetsc energy")
# linearisation of the Hessian
HESSIAN = PETSc.Log.Event("msmpetsc hessian")
# products with the true Hessian
PRODUCT = PETSc.Log.Event("msmpetsc product")
# products at the finest level of multigrid
FINE = PETSc.Log.Event("msmpetsc fine")
CYCLE = PETSc.Log.Event("msmpetsc cycle")
# grids and interpolations, which a new hierarchy reuses
GRIDS = PETSc.Log.Event("msmpetsc grids")
HIERARCHY = PETSc.Log.Event("msmpetsc hierarchy")
ESTIMATE = PETSc.Log.Event("msmpetsc estimate")
CONTACT = PETSc.Log.Event("msmpetsc contact")
GHOSTS = PETSc.Log.Event("msmpetsc ghosts")
FILES = PETSc.Log.Event("msmpetsc output")
# work of a method outside its linear solves
LOCAL = PETSc.Log.Event("msmpetsc local")


def begun(stage: PETSc.Log.Stage) -> ExitStack:
    """Begin a stage and make it visible; closing the returned stack ends the stage."""
    stage.visible = True
    stack = ExitStack()
    stack.enter_context(stage)
    return stack


def seconds(event: str) -> float:
    """Return the seconds that this rank spent in an event, in all stages of the run."""
    return float(sum(PETSc.Log.Event(event).getPerfInfo(stage)["time"] for stage in OF_THE_RUN))
