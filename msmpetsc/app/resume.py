"""``msmpetsc run --resume``: compare a run with the earlier run of a file, and continue it."""

import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from msmpetsc import __version__
from msmpetsc.app.checks import RESULT_NAMES, refuse_other_format
from msmpetsc.comm import log, on_root
from msmpetsc.errors import InputError, printable
from msmpetsc.geometry.registry import MODELS
from msmpetsc.results.checkpoint_reader import (
    Earlier,
    read_checkpoint,
    refuse_changed_lattice,
    refuse_unlike_frame,
)
from msmpetsc.results.writer import Begin, ResultFile
from msmpetsc.scene.problems import as_given
from msmpetsc.scene.reading import Scene, load_scene, scene_of
from msmpetsc.solve.petsc.words import options_of, unsafe_word

# for type checkers only: PETSc must get its options before it is imported
if TYPE_CHECKING:
    from msmpetsc.build import Model
    from msmpetsc.solve.simulate import TimeLoop

# names of PETSc options without effect on results
OF_NO_EFFECT = re.compile(
    r"_view|_monitor|_converged_reason|^log_|^options_left|^citations|^malloc"
    r"|^use_gpu_aware_mpi$|^device_"
)
# keys of a scene that cannot change within a result file
FIXED = (
    "time.step", "time.integrator",
    "output.every", "output.surface", "output.stress", "output.probe",
)  # fmt: skip
# fields of a scene that do not affect the run
IGNORED = {"text", "folder", "title", "picture"}


def earlier_run(
    comm: MPI.Comm, resume: str | PathLike[str] | None, may_start: bool
) -> Earlier | None:
    """Return the earlier run to continue, or None to run from the start (collective).

    Raises InputError if the file is no result.

    may_start : whether the run may start from its scene if the file does not exist
    """
    if resume is None:
        return None
    path = Path(resume)
    # no file yet: the first start of a job that a queue may start again
    if may_start and not comm.bcast(on_root(comm, path.exists)):
        refuse_other_format("--resume", path, RESULT_NAMES)
        return None
    earlier: Earlier = comm.bcast(on_root(comm, lambda: Earlier.read(path)))
    return earlier


def kept_options(earlier: Earlier, given: Sequence[str]) -> list[str]:
    """Return the earlier run's PETSc options that affect results and are not given again.

    given : words of this run's PETSc options

    Raises InputError for an option that could do more than choose a solver, because the file may
    come from an untrusted source.
    """
    kept: list[str] = []
    for name, value in _stored(earlier).items():
        words = [f"-{name}", *filter(None, [value])]
        if name in options_of(given) or OF_NO_EFFECT.search(name):
            continue
        if unsafe_word(words):
            raise InputError(
                f"{earlier.path} was run with {' '.join(words)}, which is not taken from a file: "
                "give it again"
            )
        kept += words
    return kept


def _stored(earlier: Earlier) -> dict[str, str]:
    """Return the PETSc options of the earlier run. Raises InputError."""
    try:
        return options_of(shlex.split(earlier.texts.get("petsc_options", "")))
    except ValueError:
        raise InputError(f"{earlier.path} is damaged: its PETSc options cannot be parsed") from None


def stored_scene(earlier: Earlier, changes: list[str]) -> Scene:
    """Return the scene stored in the earlier run's file, with changes. Raises InputError."""
    text, file = (earlier.texts.get(name) for name in ("scene", "scene_file"))
    if not text or not file or not file.isprintable():
        raise InputError(f"{earlier.path} does not say where its scene lay: name the SCENE too")
    scene = scene_of(Path(file), text, changes)
    # The result and the scene folder that it names may be untrusted. So each file of
    # the stored scene must be in the result's folder, or be named by the scene file
    # or by the user.
    known = set(MODELS)
    with suppress(InputError):
        known |= {name for _, name in load_scene(file).named_files()}
    for key, name in scene.named_files(changes):
        is_in_folder = (Path(file).parent / name).resolve().parent == earlier.path.resolve().parent
        if not (name in known or is_in_folder):
            raise InputError(
                f"{earlier.path} names {as_given(name)}, and {as_given(file)} does not: "
                f"name the SCENE too, or --set {key}=PATH"
            )
    return scene


class Resumed:
    """A run that continues an earlier run; its scene and options may differ only with ``force``.

    differs : a line for each scene key or PETSc option that has changed
    """

    def __init__(self, earlier: Earlier, scene: Scene, options: dict[str, str], force: bool):
        """Compare scene and PETSc options with the earlier run. Raises InputError for changes."""
        self.earlier = earlier
        self.force = force
        self.stored = scene.stored
        self.differs = list(self._differences(scene, options))
        if self.differs and not force:
            raise InputError("\n".join([*self.differs, "--force resumes in spite of changes"]))
        if fixed := [line for line in self.differs if line.startswith(FIXED)]:
            raise InputError("\n".join([*fixed, "these keys cannot change within a file"]))
        if (version := earlier.texts.get("msmpetsc_version")) != __version__:
            log.warning(
                "%s was started by msmpetsc %s, this is %s",
                earlier.path,
                printable(str(version), 20),
                __version__,
            )

    @property
    def is_done(self) -> bool:
        """Return whether the file already has all frames."""
        return self.earlier.finished >= self.stored

    def _differences(self, scene: Scene, options: dict[str, str]) -> Iterator[str]:
        """Yield a line for each scene key and PETSc option that has changed."""
        earlier = self.earlier
        was = _with_an_effect(_stored(earlier))
        now = _with_an_effect(options)
        if "scene" in earlier.texts:
            stored = scene_of(earlier.path, earlier.texts["scene"], to_read=False)
            for values, each in ((was, stored), (now, scene)):
                leaves = {path: value for path, value in each.leaves() if path[0] not in IGNORED}
                values |= {".".join(map(str, path)): value for path, value in leaves.items()}
        for key in sorted(was.keys() | now.keys()):
            if was.get(key) != now.get(key):
                yield f"{key}: {_shown(was.get(key))} in {earlier.path}, {_shown(now.get(key))} now"

    def file(self, comm: MPI.Comm, attributes: dict[str, Any]) -> ResultFile:
        """Open the file for writing, in place or as a copy if the run has changed (collective)."""
        earlier = self.earlier
        if not (self.differs or self.force) and earlier.planned == self.stored:
            return ResultFile(earlier.path, comm, attributes, Begin.IN_PLACE)
        before = f"{earlier.texts.get('command', '')} (to step {earlier.step})"
        attributes["earlier"] = "\n".join(filter(None, [earlier.texts.get("earlier"), before]))
        attributes["scene_file"] = attributes["scene_file"] or earlier.texts["scene_file"]
        return ResultFile(earlier.path, comm, attributes, Begin.COPY)

    def refuse_other_lattice(self, comm: MPI.Comm, model: "Model") -> None:
        """Raise InputError if the lattice differs from the earlier run's lattice (collective)."""
        lattice, own = model.lattice, slice(model.lattice.owned)
        rows = {"lattice/nodes": lattice.nodes[own]}
        if not self.differs:
            rows["lattice/mass"] = lattice.mass
        refuse_changed_lattice(comm, self.earlier.path, rows)
        if not self.differs:
            # a painted region may take its points from a file, which may have changed
            pinned = {"lattice/pinned": lattice.global_numbers[own][lattice.pinned[own]]}
            words = "a file that a pin names has changed"
            refuse_changed_lattice(comm, self.earlier.path, pinned, words)

    def restore(self, comm: MPI.Comm, simulation: "TimeLoop") -> int | None:
        """Restore the simulation from the last checkpoint, if any (collective).

        Returns the number of frames that the run keeps, None for all.
        """
        path = self.earlier.path
        saved = read_checkpoint(comm, path, simulation.model.lattice.owned)
        kept = 0
        if saved is not None:
            if saved.step >= simulation.steps:
                raise InputError(
                    f"{path} has come to step {saved.step} already: "
                    f"it cannot end at step {simulation.steps}"
                )
            kept = simulation.stored_until(saved.step)
            if kept > self.earlier.finished:
                raise InputError(f"{path} is damaged: it lacks frames from before its checkpoint")
            on_root(comm, lambda: refuse_unlike_frame(path, kept - 1))
            simulation.restore(saved)
            time = saved.step * simulation.time_step
            log.info("goes on after step %d of %d (t = %.6g s)", saved.step, simulation.steps, time)
        # frames after the checkpoint belong to the scene before its change
        return kept if self.differs else None


def _with_an_effect(options: dict[str, str]) -> dict[str, Any]:
    """Return the PETSc options that affect results, with the dash of the command line."""
    return {f"-{name}": value for name, value in options.items() if not OF_NO_EFFECT.search(name)}


def _shown(value: Any) -> str:
    """Return a value as text, None as "none"."""
    return "none" if value is None else str(list(value) if isinstance(value, tuple) else value)
