"""Films of a result: its frames as MP4, GIF or WebP, and the speed at which they play."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from msmpetsc.backend.arrays import Array, Floats, Indices
from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.results.disk import whole_file
from msmpetsc.results.progress_bar import counted
from msmpetsc.view.annotations import CAPTION, caption_picture, entries_of, legend_picture
from msmpetsc.view.composition import Composition, Still, Style, composition_of
from msmpetsc.view.drawable import Drawable
from msmpetsc.view.mesh import drawn
from msmpetsc.view.renderer import Renderer

# Sides of a film above its caption, if none are given [px]; the shortest have legible captions
LONGEST, SHORTEST = 960, np.array([240, 96])
# Sides from which on letters have their usual size [px], and the least share of that size
USUAL, SMALLEST = np.array([480, 720]), 0.5
FASTEST = 30.0  # pictures a second
LENGTHS = 3.0, 8.0  # [s] that a film lasts, where nothing is said
STEPS = (1, 2, 5)  # times powers of ten: how much slower or faster


@dataclass(frozen=True)
class Playback:
    """The frames and the speed at which a film plays.

    numbers : which of the frames each picture shows
    fps     : pictures a second
    speed   : simulated seconds a second; 0 where they are not in order of time
    """

    numbers: Indices
    fps: float
    speed: float

    @property
    def words(self) -> str:
        """Speed in words: "10 times slower than real"; "" in real time."""
        if self.speed in (0.0, 1.0):
            return ""
        if self.speed < 1:
            return f"{1 / self.speed:.3g} times slower than real"
        return f"{self.speed:.3g} times faster than real"


def usual_speed(span: float) -> float:
    """Return the round simulated seconds a second at which a time span [s] takes 3 to 8 s."""
    if not 0 < span < np.inf:
        return 1.0
    factors = np.outer(10.0 ** np.arange(20), STEPS).ravel()
    least, most = LENGTHS
    if span < least:
        return float(1 / factors[np.argmax(span * factors >= least)])
    return float(factors[np.argmax(span / factors <= most)])


def playback_of(times: Floats, speed: float | None = None) -> Playback:
    """Return the playback of frames at these times (k,) [s], which lasts 3 to 8 s unless a speed is given.

    Each picture shows the frame nearest to its time. Raises InputError where time does not go on.
    """
    steps = np.diff(times)
    if len(times) == 1 or not (steps > 0).all():
        if speed is not None:
            raise InputError("--speed needs frames in order of time, more than one")
        return Playback(np.arange(len(times)), FASTEST / 3, 0.0)
    speed = speed or usual_speed(float(times[-1] - times[0]))
    fps = max(1.0, min(FASTEST, speed / float(np.median(steps))))
    shown = times[0] + np.arange(
        0, (times[-1] - times[0]) * (1 + 1e-9) + speed / fps / 2, speed / fps
    )
    return Playback(abs(shown[:, None] - times).argmin(axis=1), fps, speed)


def write_film(
    subject: Drawable, path: Path, frames: Sequence[int], style: Style, playback: Playback
) -> None:
    """Write a film of some frames. Raises InputError where it cannot be drawn or written."""
    played = [frames[number] for number in playback.numbers]
    composition = composition_of(drawn(subject), played, style)
    stills = composition.stills(played, playback.words)
    if playback.speed:
        seconds = len(played) / playback.fps
        log.info("the film lasts %.2g s, %s", seconds, playback.words or "in real time")
    size = style.size or _usual_size(composition, stills)
    write_pictures(path, _pictures(composition, stills, size), size, playback.fps)


def _usual_size(composition: Composition, stills: list[Still]) -> tuple[int, int]:
    """Return the even width and height [px] that the view fills, above caption and legend."""
    low, high, _ = composition.room(stills)
    width, height = np.maximum((high - low) * LONGEST / (high - low).max(), SHORTEST)
    letters = _letters(width, height)
    below = letters * CAPTION + len(
        legend_picture(entries_of(composition, stills), round(width), letters)
    )
    return 2 * round(width / 2), 2 * round((height + below) / 2)


def _letters(width: float, height: float) -> float:
    """Return the size of letters in a film of some width and height [px], 1 in a sheet."""
    return float(np.clip(((width, height) / USUAL).min(), SMALLEST, 1.0))


def _pictures(
    composition: Composition, stills: list[Still], size: tuple[int, int]
) -> Iterator[Array]:
    """Yield the picture (height, width, 3) of each still; a frame that stays is drawn once."""
    width, height = size
    letters = _letters(width, height)
    legend = legend_picture(entries_of(composition, stills), width, letters)
    room = height - round(letters * CAPTION) - len(legend)
    if room < height / 4:
        raise InputError(f"--size {width}x{height}: too small for caption and legend")
    with Renderer(composition, stills, (width, room)) as renderer:
        for _, alike in groupby(counted(stills, "pictures"), key=lambda still: still.index):
            still, *others = alike
            caption = caption_picture(still.caption, width, letters)
            picture = np.concatenate([renderer.picture(still), caption, legend])
            yield from [picture] * (1 + len(others))


def write_pictures(
    path: Path, pictures: Iterable[Array], size: tuple[int, int], fps: float
) -> None:
    """Write pictures (height, width, 3) as a film. Raises InputError."""
    with whole_file(path) as part:
        if path.suffix.lower() == ".mp4":
            _write_video(part, pictures, size, fps)
        else:
            _write_images(part, pictures, fps)


def _write_video(path: Path, pictures: Iterable[Array], size: tuple[int, int], fps: float) -> None:
    """Write H.264 by ffmpeg, which the extra "movie" brings. Raises OSError for an incomplete film.

    That is asked of the film itself, for imageio-ffmpeg does not ask how ffmpeg ended.
    """
    import imageio_ffmpeg

    options: dict[str, Any] = dict(
        codec="libx264", quality=8, macro_block_size=2, ffmpeg_log_level="quiet"
    )
    sent = 0
    try:
        with closing(imageio_ffmpeg.write_frames(str(path), size, fps=fps, **options)) as writer:
            writer.send(None)
            for picture in pictures:
                writer.send(np.ascontiguousarray(picture))
                sent += 1
        count, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except (OSError, RuntimeError):
        count = -1
    if count != sent:
        raise OSError("ffmpeg did not write all of it: the disk may be full")


def _write_images(path: Path, pictures: Iterable[Array], fps: float) -> None:
    """Write an endless GIF or animated WebP by Pillow, which takes all pictures at once."""
    images = [Image.fromarray(picture) for picture in pictures]
    options: dict[str, Any] = dict(
        duration=1000 / fps, loop=0, quality=80, method=4
    )  # these two of WebP
    images[0].save(path, save_all=True, append_images=images[1:], **options)
