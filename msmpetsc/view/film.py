"""Films: the frames of a result one after the other, for 3 to 8 s, or one body turned around."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from msmpetsc.comm import log
from msmpetsc.errors import InputError
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
QUALITY = 8  # of 10, as imageio-ffmpeg counts


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
    write_pictures(path, _pictures(composition, stills, size), size, playback.fps)


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


def write_pictures(path: Path, pictures: Iterable[np.ndarray], size: tuple[int, int], fps: float) -> None:
    """Write pictures (height, width, 3) as a film, named when it is whole. Raises InputError."""
    with whole_file(path) as part:
        if path.suffix.lower() == ".mp4":
            _write_video(part, pictures, size, fps)
        else:
            _write_images(part, pictures, fps)


def _write_video(path: Path, pictures: Iterable[np.ndarray], size: tuple[int, int], fps: float) -> None:
    """Write H.264 by ffmpeg, which the extra "movie" brings. Raises OSError for a film that is not whole.

    That is asked of the film itself, for imageio-ffmpeg does not ask how ffmpeg ended.
    """
    import imageio_ffmpeg

    options: dict[str, Any] = dict(codec="libx264", quality=QUALITY, macro_block_size=2, ffmpeg_log_level="quiet")
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


def _write_images(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """Write a GIF or an animated WebP, for ever over; Pillow takes the pictures together."""
    images = [Image.fromarray(picture) for picture in pictures]
    options: dict[str, Any] = dict(quality=80, method=4)
    if path.suffix.lower() == ".gif":
        images = [image.quantize(256, dither=Image.Dither.NONE) for image in images]
        options = {}
    images[0].save(path, save_all=True, append_images=images[1:], duration=1000 / fps, loop=0, **options)
