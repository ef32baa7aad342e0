"""Films of a result: its frames as MP4, GIF or WebP, and the speed of playback."""

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

# default longer side of the view, and least width and height for legible captions [px]
LONGEST = 960
SHORTEST = np.array([240, 96])
# highest frame rate [1/s]
MAX_FPS = 30.0
# range of a film's default length, and greatest length [s]
LENGTHS = (3.0, 8.0)
LONGEST_FILM = 3600.0


@dataclass(frozen=True)
class Playback:
    """The frames and the speed of a film.

    numbers : for each picture, the position of its frame in the list of frames
    fps     : pictures per second
    speed   : simulated seconds per second
    """

    numbers: Indices
    fps: float
    speed: float

    @property
    def words(self) -> str:
        """The speed in words, "10 times slower than real"; "" in real time."""
        if self.speed == 1.0:
            return ""
        if self.speed < 1:
            return f"{1 / self.speed:.3g} times slower than real"
        return f"{self.speed:.3g} times faster than real"


def usual_speed(span: float) -> float:
    """Return a round speed [simulated s/s] at which a film of a time span [s] lasts 3 to 8 s."""
    if not 0 < span < np.inf:
        return 1.0
    factors = np.outer(10.0 ** np.arange(20), (1, 2, 5)).ravel()
    least, most = LENGTHS
    if span < least:
        return float(1 / factors[np.argmax(span * factors >= least)])
    return float(factors[np.argmax(span / factors <= most)])


def playback_of(times: Floats, speed: float | None = None) -> Playback:
    """Return which frame each picture of a film shows, and the speed of the film.

    Pictures follow at equal intervals; each shows the nearest frame.

    times : times of the frames (k,) [s]
    speed : simulated seconds per second; None for a round speed at which the film lasts 3 to 8 s

    Raises InputError if there are fewer than two frames, frames are out of order, or the film would
    last over an hour.
    """
    steps = np.diff(times)
    if not (len(steps) and (steps > 0).all()):
        raise InputError("a film needs frames in order of time, more than one")
    speed = speed or usual_speed(float(times[-1] - times[0]))
    if (seconds := float(times[-1] - times[0]) / speed) > LONGEST_FILM:
        raise InputError(f"--speed {speed:g}: the film would last {seconds:.2g} s, over an hour")
    fps = max(1.0, min(MAX_FPS, speed / float(np.median(steps))))
    shown = times[0] + np.arange(
        0, (times[-1] - times[0]) * (1 + 1e-9) + speed / fps / 2, speed / fps
    )
    return Playback(abs(shown[:, None] - times).argmin(axis=1), fps, speed)


def write_film(
    subject: Drawable, path: Path, frames: Sequence[int], style: Style, playback: Playback
) -> None:
    """Write a film of some frames. Raises InputError if it cannot be drawn or written."""
    played = [frames[number] for number in playback.numbers]
    composition = composition_of(drawn(subject), played, style)
    stills = composition.stills(played, playback.words)
    seconds = len(played) / playback.fps
    log.info("the film lasts %.2g s, %s", seconds, playback.words or "in real time")
    size = style.size or _default_size(composition, stills)
    write_pictures(path, _pictures(composition, stills, size), size, playback.fps)


def _default_size(composition: Composition, stills: list[Still]) -> tuple[int, int]:
    """Return an even width and height [px] of a film: of view, caption and legend together."""
    low, high, _ = composition.room(stills)
    width, height = np.maximum((high - low) * LONGEST / (high - low).max(), SHORTEST)
    below = CAPTION + len(legend_picture(entries_of(composition, stills), round(width)))
    return 2 * round(width / 2), 2 * round((height + below) / 2)


def _pictures(
    composition: Composition, stills: list[Still], size: tuple[int, int]
) -> Iterator[Array]:
    """Yield the picture (height, width, 3) of each still; repeated frames are drawn once."""
    width, height = size
    legend = legend_picture(entries_of(composition, stills), width)
    room = height - CAPTION - len(legend)
    if room < height / 4:
        raise InputError(f"--size {width}x{height}: too small for caption and legend")
    with Renderer(composition, stills, (width, room)) as renderer:
        for _, repeated in groupby(counted(stills, "pictures"), key=lambda still: still.index):
            still, *repeats = repeated
            caption = caption_picture(still.caption, width)
            picture = np.concatenate([renderer.picture(still), caption, legend])
            yield from [picture] * (1 + len(repeats))


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
    """Write H.264 with ffmpeg from the extra "movie". Raises OSError for an incomplete film."""
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
        # imageio-ffmpeg ignores ffmpeg's exit status, so count the file's pictures
        count, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except (OSError, RuntimeError):
        count = -1
    if count != sent:
        raise OSError("ffmpeg did not write all of it: the disk may be full")


def _write_images(path: Path, pictures: Iterable[Array], fps: float) -> None:
    """Write an endless GIF or animated WebP with Pillow, which needs all pictures in memory."""
    images = [Image.fromarray(picture) for picture in pictures]
    # quality and method apply to WebP only
    options: dict[str, Any] = dict(duration=1000 / fps, loop=0, quality=80, method=4)
    images[0].save(path, save_all=True, append_images=images[1:], **options)
