"""``msmpetsc run --resume``: what the earlier run was, whether this one is the same, and where it goes on."""

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
from msmpetsc.results.reader import refuse_deadly
from msmpetsc.results.restart import (
    Earlier,
    read_checkpoint,
    refuse_changed_lattice,
    refuse_unlike_frame,
)
from msmpetsc.results.writer import Begin, ResultFile
from msmpetsc.scene.problems import as_given
from msmpetsc.scene.reading import Scene, load_scene, scene_of
from msmpetsc.solve.petsc.words import options_of, unsafe_word

if TYPE_CHECKING:  # these import PETSc, which must first be given its options
    from msmpetsc.build import Model
    from msmpetsc.solve.simulate import TimeLoop

OF_NO_EFFECT = re.compile(  # on results
    r"_view|_monitor|_converged_reason|^log_|^options_left|^citations|^malloc|^use_gpu_aware_mpi$|^device_"
)
# a file has one of each
FIXED = (
    "time.step",
    "time.integrator",
    "output.every",
    "output.surface",
    "output.stress",
    "output.probe",
)
OF_NO_MATTER = {
    "text",
    "folder",
    "title",
    "picture",
}  # keys of a scene that may differ without a word


def earlier_run(
    comm: MPI.Comm, resume: str | PathLike[str] | None, may_start: bool
) -> Earlier | None:
    """Return the run to go on from, None to run from the start (collective). Raises InputError.

    may_start : whether there is a scene to start from, where there is no such file yet
    """
    if resume is None:
        return None
    path = Path(resume)
    if may_start and not comm.bcast(on_root(comm, path.exists)):
        refuse_other_format("--resume", path, RESULT_NAMES)
        return None  # the first start of a job that may be started again
    on_root(comm, lambda: refuse_deadly(path))
    earlier: Earlier = comm.bcast(on_root(comm, lambda: Earlier.read(path)))
    return earlier


def kept_options(earlier: Earlier, given: Sequence[str]) -> list[str]:
    """Return the earlier run's options of PETSc that affect results and are not given again, as words.

    Raises InputError for one that could do more than choose a solver: the file may be from anywhere.
    """
    kept: list[str] = []
    for name, value in _stored(earlier).items():
        words = [f"-{name}", *filter(None, [value])]
        if name in options_of(given) or OF_NO_EFFECT.search(name):
            continue
        if unsafe_word(words):
            text = f"{earlier.path} was run with {' '.join(words)}"
            raise InputError(f"{text}, which is not taken from a file: give it again")
        kept += words
    return kept


def _stored(earlier: Earlier) -> dict[str, str]:
    """Return PETSc's options of the earlier run."""
    try:
        return options_of(shlex.split(earlier.texts.get("petsc_options", "")))
    except ValueError:
        raise InputError(
            f"{earlier.path} is damaged: its PETSc options cannot be taken apart"
        ) from None


def stored_scene(earlier: Earlier, changes: list[str]) -> Scene:
    """Return the scene that the earlier run's file has, with changes. Raises InputError."""
    text, file = (earlier.texts.get(name) for name in ("scene", "scene_file"))
    if not text or not file or not file.isprintable():
        raise InputError(f"{earlier.path} does not say where its scene lay: name the SCENE too")
    scene = scene_of(Path(file), text, changes)
    # The result may be from anywhere, and so may be what it says of the folder in which its scene lay: each file that
    # it names must lie beside it, or be named by that scene's file or by the user.
    given = [tuple(change.partition("=")[0].strip().split(".")) for change in changes]
    known = set(MODELS)
    with suppress(InputError):
        known |= {name for _, name in load_scene(file).named_files()}
    for path, name in scene.named_files():
        keys = tuple(map(str, path))
        lies_beside = (Path(file).parent / name).resolve().parent == earlier.path.resolve().parent
        if not (name in known or lies_beside or any(keys[: len(own)] == own for own in given)):
            raise InputError(
                f"{earlier.path} names {as_given(name)}, and {as_given(file)} does not: name the SCENE too, "
                f"or --set {'.'.join(keys)}=PATH"
            )
    return scene


class Resumed:
    """A run that goes on from an earlier one, if it is the same or is forced to.

    differs : lines that say what is not as it was
    """

    def __init__(self, earlier: Earlier, scene: Scene, options: dict[str, str], force: bool):
        """Compare scenes and PETSc's options. Raises InputError for what may not differ."""
        self.earlier = earlier
        self.force = force
        self.stored = scene.stored
        self.differs = list(self._differences(scene, options))
        if self.differs and not force:
            raise InputError("\n".join([*self.differs, "--force goes on all the same"]))
        if fixed := [line for line in self.differs if line.startswith(FIXED)]:
            raise InputError("\n".join([*fixed, "that cannot change within a file"]))
        if (version := earlier.texts.get("msmpetsc_version")) != __version__:
            log.warning(
                "%s was begun by msmpetsc %s, this is %s",
                earlier.path,
                printable(str(version), 20),
                __version__,
            )

    @property
    def is_done(self) -> bool:
        """Return whether the file has all frames already."""
        return self.earlier.finished >= self.stored

    def _differences(self, scene: Scene, options: dict[str, str]) -> Iterator[str]:
        earlier = self.earlier
        was = _with_an_effect(_stored(earlier))
        now = _with_an_effect(options)
        if "scene" in earlier.texts:
            was |= flat(scene_of(earlier.path, earlier.texts["scene"], to_read=False))
            now |= flat(scene)
        for key in sorted(was.keys() | now.keys()):
            if was.get(key) != now.get(key):
                yield f"{key}: {_shown(was.get(key))} in {earlier.path}, {_shown(now.get(key))} now"

    def file(self, comm: MPI.Comm, attributes: dict[str, Any], gathers: bool) -> ResultFile:
        """Open the file that the run writes into (collective)."""
        earlier = self.earlier
        if not (self.differs or self.force) and earlier.planned == self.stored:
            return ResultFile(earlier.path, comm, attributes, Begin.IN_PLACE, gathers)
        before = f"{earlier.texts.get('command', '')} (to step {earlier.step})"
        attributes["earlier"] = "\n".join(filter(None, [earlier.texts.get("earlier"), before]))
        attributes["scene_file"] = attributes["scene_file"] or earlier.texts["scene_file"]
        return ResultFile(earlier.path, comm, attributes, Begin.COPY, gathers)

    def refuse_other_lattice(self, comm: MPI.Comm, model: "Model") -> None:
        """Raise InputError where the mesh makes another lattice than it did (collective)."""
        lattice = model.lattice
        rows = {"lattice/nodes": lattice.nodes[: lattice.owned]}
        if not self.differs:
            rows["lattice/mass"] = lattice.mass
        refuse_changed_lattice(comm, self.earlier.path, rows)

    def restore(self, comm: MPI.Comm, file: ResultFile, simulation: "TimeLoop") -> None:
        """Put the simulation where the last checkpoint was (collective)."""
        path = self.earlier.path
        saved = read_checkpoint(comm, path, simulation.model.lattice.owned)
        kept = 0
        if saved is not None:
            if saved.step >= simulation.steps:
                end = f"it cannot end at step {simulation.steps}"
                raise InputError(f"{path} has come to step {saved.step} already: {end}")
            kept = simulation.stored_until(saved.step)
            if kept > self.earlier.finished:
                raise InputError(f"{path} is damaged: it lacks frames of before its checkpoint")
            is_frame = (kept - 1) * simulation.every == saved.step
            on_root(comm, lambda: refuse_unlike_frame(path, kept - 1, is_frame))
        if self.differs:  # later frames are of how it was
            file.keep(kept)
        if saved is None:
            return
        simulation.restore(saved)
        time = saved.step * simulation.time_step
        log.info("goes on after step %d of %d (t = %.6g s)", saved.step, simulation.steps, time)


def flat(scene: Scene) -> dict[str, Any]:
    """Return the scene's values by keys like "time.step" and "obstacle.0.point", those that are given."""
    return dict(_leaves("", scene.model_dump(exclude=OF_NO_MATTER, exclude_none=True)))


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, (list, tuple)) and any(isinstance(item, dict) for item in value):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield name, value
        return
    for key, inner in value.items():
        yield from _leaves(f"{name}.{key}".lstrip("."), inner)


def _with_an_effect(options: dict[str, str]) -> dict[str, Any]:
    """Return PETSc's options that have an effect on results, by what stands on the command line."""
    return {f"-{name}": value for name, value in options.items() if not OF_NO_EFFECT.search(name)}


def _shown(value: Any) -> str:
    return "none" if value is None else str(list(value) if isinstance(value, tuple) else value)
