"""``msmpetsc render``: draw pictures, films and pages of a result, or of a scene at rest."""

import argparse
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from msmpetsc.app.checks import (
    MOVIE_NAMES,
    PAGE_NAMES,
    PICTURE_NAMES,
    RESULT_NAMES,
    SCENE_NAMES,
    refuse_other_format,
)
from msmpetsc.errors import InputError
from msmpetsc.fields import Frame
from msmpetsc.results.frame_choice import Frames, frames_of
from msmpetsc.results.reader import Result
from msmpetsc.results.untrusted_file import plain_damage
from msmpetsc.scene.reading import load_scene
from msmpetsc.view.composition import Style, composition_of
from msmpetsc.view.drawable import Drawable, drawable_of_result
from msmpetsc.view.film import playback_of, write_film
from msmpetsc.view.mesh import cut_open, drawn
from msmpetsc.view.page import write_page
from msmpetsc.view.sheet import contact_sheet, draw_panels

# smallest and largest side of a picture [px]; Mesa cannot draw larger pictures
SIZES = 64, 8192
# default size of a panel of a scene [px]
STILL = (760, 900)
# formats that each option is for
ONLY = {
    "count": PICTURE_NAMES,
    "size": (*PICTURE_NAMES, *MOVIE_NAMES),
    "speed": MOVIE_NAMES,
    "cells": (*PICTURE_NAMES, *MOVIE_NAMES),
}


def run(args: argparse.Namespace) -> int:
    """Draw a result or a scene and print the path; return the exit status."""
    refuse_other_format("-o", args.output, (*PICTURE_NAMES, *MOVIE_NAMES, *PAGE_NAMES))
    path = args.output or args.subject.with_suffix(".png")
    ending = path.suffix.lower()
    for option, endings in ONLY.items():
        if getattr(args, option) and ending not in endings:
            raise InputError(
                f"--{option} is for {', '.join(f'*{end}' for end in endings)}, not for {path}"
            )
    style = style_of(args)
    if args.subject.suffix.lower() in RESULT_NAMES:
        _draw_result(args, path, style)
    else:
        _draw_unrun(args, path, style)
    print(path)
    return 0


def style_of(args: argparse.Namespace) -> Style:
    """Return the style that the options describe. Raises InputError."""
    eye = None if args.eye is None else _direction(args.eye)
    if args.speed is not None and not 0 < args.speed < np.inf:
        raise InputError(f"--speed must be above 0, not {args.speed:g}")
    return Style(eye, args.colour, _size(args.size), args.cells)


def _draw_result(args: argparse.Namespace, path: Path, style: Style) -> None:
    """Draw a result as a picture, a page or a film, by the ending of the path."""
    if args.set:
        raise InputError(f"--set is for scenes, and {args.subject} is a result")
    if path.suffix.lower() in PICTURE_NAMES:
        contact_sheet(args.subject, path, args.frames, args.count, style)
        return
    with plain_damage(args.subject), Result(args.subject) as run:
        subject = drawable_of_result(run)
        all_frames: Frames = [slice(None)]
        numbers = frames_of(subject.name, args.frames or all_frames, len(subject.times))
        if path.suffix.lower() in PAGE_NAMES:
            write_page(subject, path, numbers, style)
        else:
            playback = playback_of(subject.times[numbers], args.speed)
            write_film(subject, path, numbers, style, playback)


def _draw_unrun(args: argparse.Namespace, path: Path, style: Style) -> None:
    """Draw a scene at rest as a picture or a page, by the ending of the path."""
    refuse_other_format("render", args.subject, (*RESULT_NAMES, *SCENE_NAMES))
    for option in ("frames", "count", "speed"):
        if getattr(args, option) is not None:
            raise InputError(f"--{option} is for results, and {args.subject} is a scene")
    if path.suffix.lower() in MOVIE_NAMES:
        raise InputError(f"{args.subject} has no motion to film: *.html turns it around")
    with TemporaryDirectory(prefix="msmpetsc-render-") as folder:
        result = Path(folder, "start.h5")
        cells = _write_start(args.subject, args.set, result)
        with Result(result) as run:
            subject = drawable_of_result(run, str(args.subject))
            if path.suffix.lower() in PICTURE_NAMES:
                _draw_start(subject, cells, path, style)
            else:
                write_page(subject, path, [0], style)


def _draw_start(subject: Drawable, cells: str, path: Path, style: Style) -> None:
    """Draw bodies before their first step as a picture, also cut open, with a line on the cells."""
    sides = " x ".join(f"{length:.4g}" for length in np.ptp(subject.rest.points, axis=0))
    composition = composition_of(drawn(subject), [0], replace(style, size=style.size or STILL))
    (still,) = composition.stills([0])
    stills = [replace(still, caption=(subject.title, f"{sides} m"))]
    if not style.cells:
        cut = cut_open(subject, composition.camera)
        stills.append(replace(still, caption=("cut open", cells), cut=cut))
    draw_panels(composition, stills, path)


def _write_start(path: Path, changes: list[str], result: Path) -> str:
    """Write the start of a scene as a result of a single frame; return the number of cells as text.

    Raises InputError.
    """
    # imported here, as drawing a result needs neither MPI nor compiled kernels
    from mpi4py import MPI

    from msmpetsc.build import build_model
    from msmpetsc.results.checkpoint_reader import end_of_run
    from msmpetsc.results.writer import ResultFile, write_model

    scene = load_scene(path, changes)
    comm = MPI.COMM_SELF
    model = build_model(comm, scene, None, partial(end_of_run, comm, scene.folder))
    lattice = model.lattice
    with ResultFile(result, comm, {"scene": scene.text}) as file:
        write_model(comm, file, model)
        file.start_frames(1, lattice.owned)
        file.append(Frame(0, 0.0, model.start[0][: lattice.owned]))
    return f"{len(lattice.cells)} cells of {lattice.cell_size:.4g} m, {lattice.owned} nodes"


def _size(text: str | None) -> tuple[int, int] | None:
    """Return width and height of "960x720", both even, as films require. Raises InputError."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text, re.ASCII)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    low, high = SIZES
    if not all(low <= side <= high and side % 2 == 0 for side in size):
        raise InputError(
            f"--size takes two even numbers from {low} to {high}, like 960x720, not {text!r}"
        )
    return size


def _direction(text: str) -> tuple[float, ...]:
    """Return the vector (3,) of "1,-2,0.6". Raises InputError."""
    try:
        vector = tuple(map(float, text.split(",")))
    except ValueError:
        raise InputError(f"--eye takes numbers like 1,-2,0.6, not {text!r}") from None
    if not (len(vector) == 3 and any(vector) and np.isfinite(vector).all()):
        raise InputError(f"--eye takes three numbers, not all zero, not {text!r}")
    return vector
