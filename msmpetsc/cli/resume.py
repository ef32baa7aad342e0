"""``msmpetsc run --resume``: what the earlier run was, whether this one is the same, and where it goes on."""

import argparse
import re
import shlex
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from msmpetsc import __version__
from msmpetsc.cli.arguments import RESULT_NAMES, refuse_other_format
from msmpetsc.comm import log, on_root
from msmpetsc.errors import InputError, printable
from msmpetsc.output.reader import refuse_deadly
from msmpetsc.output.restart import Earlier, read_checkpoint, refuse_changed_lattice
from msmpetsc.output.writer import Begin, ResultFile
from msmpetsc.scene.reading import load_scene, scene_of
from msmpetsc.scene.schema import Scene
from msmpetsc.study.schema import beside_solving

if TYPE_CHECKING:  # these import PETSc, which must first be given its options
    from msmpetsc.model.build import Model
    from msmpetsc.solve.simulate import Simulation

OF_NO_EFFECT = re.compile(  # on results
    r"_view|_monitor|_converged_reason|^log_|^options_left|^citations|^malloc|^use_gpu_aware_mpi$|^device_"
)
FIXED = ("time.step", "time.integrator", "output.every", "output.surface")  # a file has one of each
UNHEARD = {"text", "folder", "title", "picture"}  # what may differ in silence


def look(comm: MPI.Comm, args: argparse.Namespace) -> Earlier | None:
    """What is to be resumed; None for a run from the start (collective)."""
    if args.resume is None:
        if args.scene is None:
            raise InputError("a SCENE is needed, or --resume OUT.h5")
        return None
    if args.overwrite or args.output not in (None, args.resume):
        raise InputError("--resume goes on in its own file: -o and --overwrite have no place beside it")
    args.output = args.resume
    there = comm.bcast(on_root(comm, args.resume.exists))
    if not there and args.scene:
        refuse_other_format("--resume", args.resume, RESULT_NAMES)
        return None  # the first start of a job that may be started again
    earlier = comm.bcast(on_root(comm, lambda: look_closely(args.resume)))
    args.petsc_options = [*_stored_options(earlier, _as_options(args.petsc_options)), *args.petsc_options]
    args.true_error = args.true_error or earlier.true_error or None
    return earlier


def read_scene(args: argparse.Namespace, earlier: Earlier | None, changes: list[str], presets: Any) -> Scene:
    """The scene file, or what the earlier run's file has of it, with changes."""
    if args.scene is not None:
        return load_scene(args.scene, changes, presets)
    return _stored_scene(earlier, changes, presets)


def look_closely(path: Path) -> Earlier:
    """For one rank."""
    refuse_deadly(path)
    return Earlier.read(path)


def _stored_options(earlier: Earlier, given: Collection[str]) -> Iterator[str]:
    """PETSc's, of the earlier run, less those without effect on results. Raises InputError for one that could do more
    than choose a solver, and is not ``given`` again: the file may be from anywhere."""
    for name, value in _stored(earlier).items():
        words = [f"-{name}", value] if value else [f"-{name}"]
        if name in given or OF_NO_EFFECT.search(name):
            continue
        if beside_solving(words):
            raise InputError(
                f"{earlier.path} was run with {' '.join(words)}, which is not taken from a file: give it again"
            )
        yield from words


def _stored(earlier: Earlier) -> dict[str, str]:
    try:
        return _as_options(shlex.split(earlier.texts.get("petsc_options", "")))
    except ValueError:
        raise InputError(f"{earlier.path} is damaged: its PETSc options cannot be taken apart") from None


def _stored_scene(earlier: Earlier, changes: list[str], presets: Any) -> Scene:
    text, file = (earlier.texts.get(name) for name in ("scene", "scene_file"))
    if not text or not file or not file.isprintable():
        raise InputError(f"{earlier.path} does not say where its scene lay: name the SCENE too")
    return scene_of(Path(file), text, changes, presets)


class Resumed:
    """The way of one run that goes on.

    differs : lines that tell what is not as it was
    """

    def __init__(self, earlier: Earlier, scene: Scene, options: dict[str, str], force: bool):
        """options: PETSc's, now. Raises InputError for what may not differ."""
        self.earlier, self.force = earlier, force
        self.stored = scene.stored
        self.differs = list(self._differences(scene, options))
        if self.differs and not force:
            raise InputError("\n".join([*self.differs, "--force goes on all the same"]))
        fixed = [line for line in self.differs if line.startswith(FIXED)]
        if fixed:
            raise InputError("\n".join([*fixed, "that cannot change within a file"]))
        if (version := earlier.texts.get("msmpetsc_version")) != __version__:
            log.warning(
                "%s was begun by msmpetsc %s, this is %s", earlier.path, printable(str(version), 20), __version__
            )

    @property
    def is_done(self) -> bool:
        """Whether the file has all frames already."""
        return self.earlier.finished >= self.stored

    def _differences(self, scene: Scene, options: dict[str, str]) -> Iterator[str]:
        earlier = self.earlier
        if "scene" in earlier.texts:
            was = flat(scene_of(earlier.path, earlier.texts["scene"], to_read=False))
            now = flat(scene)
            for key in sorted(was.keys() | now.keys()):
                if was.get(key) != now.get(key):
                    yield f"{key}: {_told(was.get(key))} in {earlier.path}, {_told(now.get(key))} now"
        was = _stored(earlier)
        for name in sorted(was.keys() | options.keys()):
            if was.get(name) != options.get(name) and not OF_NO_EFFECT.search(name):
                yield f"-{name}: {_told(was.get(name))} in {earlier.path}, {_told(options.get(name))} now"

    def file(self, comm: MPI.Comm, attributes: dict, gathers: bool) -> ResultFile:
        """To write into (collective)."""
        earlier = self.earlier
        if not (self.differs or self.force) and earlier.planned == self.stored and earlier.exact:
            return ResultFile(earlier.path, comm, attributes, Begin.IN_PLACE, gathers)
        before = f"{earlier.texts.get('command', '')} (to step {earlier.step})"
        attributes["earlier"] = "\n".join(filter(None, [earlier.texts.get("earlier"), before]))
        attributes["scene_file"] = attributes["scene_file"] or earlier.texts["scene_file"]
        return ResultFile(earlier.path, comm, attributes, Begin.COPY, gathers)

    def refuse_other_lattice(self, comm: MPI.Comm, model: "Model") -> None:
        """Raises InputError where the mesh makes another lattice than it did (collective)."""
        lattice = model.lattice
        found = {"lattice/nodes": lattice.nodes[: lattice.owned]}
        if not self.differs:
            found["lattice/mass"] = lattice.mass
        refuse_changed_lattice(comm, self.earlier.path, found)

    def restore(self, comm: MPI.Comm, file: ResultFile, simulation: "Simulation") -> None:
        """Put the simulation where the last checkpoint was (collective)."""
        path, saved = self.earlier.path, read_checkpoint(comm, self.earlier.path, simulation.model.lattice.owned)
        if saved is not None and saved.step >= simulation.steps:
            raise InputError(f"{path} has come to step {saved.step} already: it cannot end at step {simulation.steps}")
        kept = 0 if saved is None else simulation.stored_until(saved.step)
        if kept > self.earlier.finished:
            raise InputError(f"{path} is damaged: it lacks frames of before its checkpoint")
        if self.differs:  # later frames are of how it was
            file.keep(kept)
        if saved is None:
            return
        simulation.restore(saved)
        time = saved.step * simulation.time_step
        log.info("goes on after step %d of %d (t = %.6g s)", saved.step, simulation.steps, time)


def flat(scene: Scene) -> dict[str, Any]:
    """Keys like "time.step" and "obstacle.0.point"; what is not given is not there."""
    return dict(_leaves("", scene.model_dump(exclude=UNHEARD, exclude_none=True)))


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    items = value.items() if isinstance(value, dict) else ()
    if isinstance(value, (list, tuple)) and any(isinstance(item, dict) for item in value):
        items = enumerate(value)
    for key, inner in items:
        yield from _leaves(f"{name}.{key}" if name else str(key), inner)
    if not isinstance(value, dict) and not items:
        yield name, value


def _told(value: Any) -> str:
    return "none" if value is None else str(list(value) if isinstance(value, tuple) else value)


def _as_options(words: list[str]) -> dict[str, str]:
    """PETSc's, as its database has them."""
    found, name = {}, None
    for word in words:
        if re.match(r"-[A-Za-z]", word):
            name = word[1:]
            found[name] = ""
        elif name:
            found[name] = word
    return found
