"""What -log_view shows of a run: events by what is done, and stages of the run.

An event within another counts in both, as PETSc's own do: KSPSolve has the products that it makes.
What is done at the levels of multigrid -pc_mg_log shows.
"""

from contextlib import ExitStack

from petsc4py import PETSc

SETUP, STEPS, OUTPUT = (PETSc.Log.Stage(name) for name in ("set-up", "steps", "output"))
REFERENCE = PETSc.Log.Stage("reference")  # steps solved once more, which are no part of the run
for unused in REFERENCE, PETSc.Log.Stage("PCMPI"):  # PETSc's own of -mpi_linear_solver_server
    unused.visible = False  # -log_view calls a stage that never begins Unknown
OF_THE_RUN = (
    0,
    SETUP.id,
    STEPS.id,
    OUTPUT.id,
)  # 0: PETSc's own, before the set-up and after the last frame

GRADIENT = PETSc.Log.Event("msmpetsc gradient")
ENERGY = PETSc.Log.Event("msmpetsc energy")  # differences of g
HESSIAN = PETSc.Log.Event("msmpetsc hessian")  # its linearisation
PRODUCT = PETSc.Log.Event("msmpetsc product")  # with the true Hessian
FINE = PETSc.Log.Event("msmpetsc fine")  # a product at the finest level of the cycle
CYCLE = PETSc.Log.Event("msmpetsc cycle")
GRIDS = PETSc.Log.Event("msmpetsc grids")  # all of a hierarchy that stays when it is built anew
HIERARCHY = PETSc.Log.Event("msmpetsc hierarchy")
ESTIMATE = PETSc.Log.Event("msmpetsc estimate")
CONTACT = PETSc.Log.Event("msmpetsc contact")
GHOSTS = PETSc.Log.Event("msmpetsc ghosts")
FILES = PETSc.Log.Event("msmpetsc output")
LOCAL = PETSc.Log.Event("msmpetsc local")  # all that is done spring by spring outside of KSP


def begun(stage: PETSc.Log.Stage) -> ExitStack:
    """Begin a stage, which ends when the stack is closed; -log_view shows it from then on."""
    stage.visible = True
    stack = ExitStack()
    stack.enter_context(stage)
    return stack


def seconds(event: str) -> float:
    """Seconds that this rank spent in an event, in all stages of the run."""
    return float(sum(PETSc.Log.Event(event).getPerfInfo(stage)["time"] for stage in OF_THE_RUN))
