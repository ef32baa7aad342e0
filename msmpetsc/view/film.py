"""Films: the frames of a result one after the other, for 3 to 8 s, or one body turned around."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from PIL import Image

from msmpetsc.comm import log
from msmpetsc.errors import InputError, printable
from msmpetsc.results.disk import whole_file
from msmpetsc.results.progress import counted
from msmpetsc.results.reader import Result
from msmpetsc.view.annotations import CAPTION, Entry, caption_picture, entries_of, legend_picture, scale_bar
from msmpetsc.view.drawable import Drawable
from msmpetsc.view.mesh import LatticeMesh, cut_open, drawn
from msmpetsc.view.overlays import MARGIN
from msmpetsc.view.playback import Extent, Playback, Style, View, extent_of, room_of, views_of
from msmpetsc.view.renderer import Panel, Renderer
from msmpetsc.view.sheet import LABELS

LONGEST, SHORTEST = 960, np.array([480, 320])  # [px]: sides of a film, where nothing is said
USUAL, SMALLEST = 720, 0.5  # [px]: height where captions and legend have their usual size; the least share of that
TURN = 6.0  # [s] that the eye takes to go around a body that stands still
QUALITY = 10  # as ffmpeg's -crf counts: 0 without loss, 51 the worst


def write_film(
    subject: Drawable, path: Path, frames: Sequence[int], style: Style, playback: Playback, turns: float = 0.0,
    reference: Result | None = None,
) -> None:  # fmt: skip
    """Write a film of these frames at a playback; from start to end the eye goes so many times around the body.

    Raises InputError where it cannot be drawn or written.
    """
    subject = drawn(subject)
    played = [frames[number] for number in playback.numbers]
    seen = extent_of(subject, played, style, reference)
    views = views_of(subject, played, seen, turns)
    if playback.speed:
        log.info("the film lasts %.2g s, %s", playback.seconds, playback.words or "in real time")
    size = style.size or _fitting(views, seen, style)
    with written(path, size, playback.fps) as add:
        for picture in _pictures(subject, views, seen, replace(style, size=size), playback.words):
            add(picture)


def _fitting(views: list[View], seen: Extent, style: Style) -> tuple[int, int]:
    """Return width and height [px], both even, of a film that what is seen fills."""
    low, high, _ = room_of(views, seen, LABELS if style.axes else MARGIN)
    width, height = np.clip((high - low) * LONGEST / (high - low).max(), SHORTEST, LONGEST)
    return 2 * round(width / 2), 2 * round((height + CAPTION) / 2)


def _pictures(subject: Drawable, views: list[View], seen: Extent, style: Style, words: str) -> Iterator[np.ndarray]:
    """Yield the picture (height, width, 3) of each view; of equal ones in a row the first is drawn only."""
    assert style.size
    width, height = style.size
    low, high, depth = room_of(views, seen, LABELS if style.axes else MARGIN)
    entries = entries_of(subject.scene, seen.fixed, [view.overlays for view in views], seen.colouring, style.shown)
    letters = min(1.0, max(height / USUAL, SMALLEST))
    bar = [Entry("length", "")] if style.scale_bar else []
    room = height - round(letters * CAPTION) - len(legend_picture([*entries, *bar], width, letters))
    scale = min(width / (high - low)[0], room / (high - low)[1])  # [px/m]
    if room < height / 4:
        raise InputError(f"--size {width}x{height}: too small for caption and legend")
    bar = [scale_bar(scale / letters, width / letters / 5)] if style.scale_bar else []
    legend = legend_picture([*entries, *bar], width, letters)
    across, upward = (low + high) / 2
    middle = seen.box.mean(axis=0)
    cut = cut_open(subject, seen.camera, style.shown) if style.shown else None
    before: View | None = None
    picture = np.empty(0)
    with Renderer(width, room, subject.triangles) as renderer:
        for view in counted(views, "pictures"):
            if before is None or view.index != before.index or view.camera is not before.camera:
                camera = view.camera
                centre = across * camera.right + upward * camera.upward + middle @ camera.to_eye * camera.to_eye
                renderer.face(camera, centre, room / scale, depth)
                lattice = cut.meshes(subject.nodes(view.index)) if cut else ()
                panel = _panel(subject, view, seen, style, lattice, words)
                picture = np.concatenate(
                    [renderer.picture(panel), caption_picture(panel.caption, width, letters), legend]
                )
            before = view
            yield picture


def _panel(
    subject: Drawable, view: View, seen: Extent, style: Style, lattice: tuple[LatticeMesh, ...], words: str
) -> Panel:
    """Return the panel of a view, with its time and how much slower or faster than real it goes, in words."""
    return Panel(
        points=subject.surface(view.index),
        fixed=subject.fixed(view.index),
        overlays=view.overlays,
        caption=(f"t = {subject.times[view.index]:.3f} s", words),
        colours=seen.colouring.rgb(view.index) if seen.colouring else None,
        lattice=lattice,
        axes=seen.box if style.axes else None,
    )


@contextmanager
def written(path: Path, size: tuple[int, int], fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield what adds a picture (height, width, 3) to a film, which has its name when it is whole."""
    write = _video if path.suffix.lower() == ".mp4" else _images
    with whole_file(path) as part, write(part, size, fps) as add:
        yield add


@contextmanager
def _video(path: Path, size: tuple[int, int], fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Write H.264 by ffmpeg, which the extra "movie" brings. Raises OSError with the last that ffmpeg says.

    imageio-ffmpeg's own writer does not ask how ffmpeg ended: on a full disk it leaves a film that nothing can open.
    """
    import imageio_ffmpeg

    pictures = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "{}x{}".format(*size)]
    rate = ["-r", str(Fraction(fps).limit_denominator())]
    film = ["-an", "-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", str(QUALITY)]
    careful = ["-v", "error", "-xerror", "-y"]  # its older versions end a film that they could not close as done
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *careful, *pictures, *rate, "-i", "-", *film, str(path)]
    # signals stay as they are here: what is too long for the system is told like what has no room, and Ctrl-C is ours
    system: dict[str, Any] = dict(restore_signals=False, start_new_session=True)
    with TemporaryFile() as said, Popen(command, stdin=PIPE, stdout=DEVNULL, stderr=said, **system) as ffmpeg:
        stream: Any = ffmpeg.stdin
        broken = False
        try:
            yield lambda picture: stream.write(np.ascontiguousarray(picture))
        except BrokenPipeError:  # it has ended, and says why
            broken = True
        except BaseException:
            ffmpeg.kill()
            raise
        finally:
            with suppress(BrokenPipeError):
                stream.close()
        if ffmpeg.wait() or broken:
            said.seek(0)
            reason = said.readline().decode(errors="replace").rpartition("] ")[2].strip()
            raise OSError(printable(reason) or f"ffmpeg ended with status {ffmpeg.returncode}")


@contextmanager
def _images(path: Path, size: tuple[int, int], fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Write a GIF or an animated WebP, for ever over; Pillow takes the pictures together."""
    pictures: list[Image.Image] = []
    is_gif = path.suffix.lower() == ".gif"

    def add(picture: np.ndarray) -> None:
        image = Image.fromarray(picture)
        pictures.append(image.quantize(256, dither=Image.Dither.NONE) if is_gif else image)

    yield add
    options: dict[str, Any] = {} if is_gif else dict(quality=80, method=4)
    first, *rest = pictures
    first.save(path, save_all=True, append_images=rest, duration=1000 / fps, loop=0, **options)
