"""Films: the frames of a result one after the other, for 3 to 8 s, or one body turned around."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
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
from msmpetsc.results.progress_bar import counted
from msmpetsc.results.reader import Result
from msmpetsc.view.annotations import CAPTION, caption_picture, entries_of, legend_picture
from msmpetsc.view.composition import Composition, Still, Style, composition_of
from msmpetsc.view.drawable import Drawable
from msmpetsc.view.mesh import drawn
from msmpetsc.view.playback import Playback
from msmpetsc.view.renderer import Renderer

LONGEST, SHORTEST = 960, np.array([480, 320])  # [px]: sides of a film, where nothing is said
USUAL, SMALLEST = 720, 0.5  # [px]: height where captions and legend have their usual size; the least share of that
TURN = 6.0  # [s] that the eye takes to go around a body that stands still
QUALITY = 10  # as ffmpeg's -crf counts: 0 without loss, 51 the worst


def write_film(
    subject: Drawable,
    path: Path,
    frames: Sequence[int],
    style: Style,
    playback: Playback,
    reference: Result | None = None,
) -> None:
    """Write a film of these frames at a playback. Raises InputError where it cannot be drawn or written."""
    played = [frames[number] for number in playback.numbers]
    composition = composition_of(drawn(subject), played, style, reference)
    stills = composition.stills(played, playback.turns, playback.words)
    if playback.speed:
        seconds = len(played) / playback.fps
        log.info("the film lasts %.2g s, %s", seconds, playback.words or "in real time")
    size = style.size
    if size is None:  # what is seen fills it; both sides are even
        low, high, _ = composition.room(stills)
        width, height = np.clip((high - low) * LONGEST / (high - low).max(), SHORTEST, LONGEST)
        size = 2 * round(width / 2), 2 * round((height + CAPTION) / 2)
    with written(path, size, playback.fps) as add:
        for picture in _pictures(composition, stills, size):
            add(picture)


def _pictures(composition: Composition, stills: list[Still], size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield the picture (height, width, 3) of each still; of equal ones in a row the first is drawn only."""
    width, height = size
    letters = min(1.0, max(height / USUAL, SMALLEST))
    entries = entries_of(composition, stills)
    legend = legend_picture(entries, width, letters)
    room = height - round(letters * CAPTION) - len(legend)
    if room < height / 4:
        raise InputError(f"--size {width}x{height}: too small for caption and legend")
    before, picture = None, np.empty(0)
    with Renderer(composition, stills, (width, room)) as renderer:
        for still in counted(stills, "pictures"):
            if still is not before:
                caption = caption_picture(still.caption, width, letters)
                picture = np.concatenate([renderer.picture(still), caption, legend])
            before = still
            yield picture


@contextmanager
def written(path: Path, size: tuple[int, int], fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield what adds a picture (height, width, 3) to a film, named when it is whole."""
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
