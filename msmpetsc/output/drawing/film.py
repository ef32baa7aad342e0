"""Films: the frames of a result one after the other, in real time or slower, or one body turned around."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from PIL import Image

from msmpetsc.comm import log
from msmpetsc.errors import InputError, printable
from msmpetsc.output.disk import whole_file
from msmpetsc.output.drawing.fabric import Fabric, cut_open
from msmpetsc.output.drawing.legend import Entry, entries_of, legend_picture, scale_bar
from msmpetsc.output.drawing.overlays import MARGIN
from msmpetsc.output.drawing.sheet import CAPTION, LABELS
from msmpetsc.output.drawing.shots import Shot, Style, Survey, room_of, shots_of, survey
from msmpetsc.output.drawing.stage import Panel, Stage
from msmpetsc.output.drawing.subject import Subject
from msmpetsc.output.progress import counted
from msmpetsc.output.reader import Result

SIZE = (960, 720)  # [px]
SMALLEST = 0.5  # of the usual size: captions and legend of small films
FASTEST = 30.0  # pictures a second, where nothing is said
TURN = 6.0  # [s] that the eye takes to go around a body that stands still
SHORT = 1.0  # [s]: who makes a film shorter than this is told how to make it longer
QUALITY = 10  # as ffmpeg's -crf counts: 0 without loss, 51 the worst


@dataclass(frozen=True)
class Pace:
    """How fast a film goes.

    numbers : which of the frames each picture shows
    fps     : pictures a second
    speed   : simulated seconds a second; 0 where time stands still
    """

    numbers: np.ndarray
    fps: float
    speed: float

    @property
    def seconds(self) -> float:
        """Length of the film [s]."""
        return len(self.numbers) / self.fps


def paced(times: np.ndarray, fps: float | None = None, speed: float | None = None) -> Pace:
    """Return the pace of frames at these times (k,) [s].

    In real time unless fps or speed says otherwise. With fps alone every frame is one picture; with both, or speed,
    each picture shows the frame nearest to its time. Raises InputError where time does not go on.
    """
    count = np.arange(len(times))
    steps = np.diff(times)
    if len(times) == 1 or not (steps > 0).all():
        if speed is not None:
            raise InputError("--speed needs frames in order of time, more than one")
        return Pace(count, fps or FASTEST / 3, 0.0)
    if fps is not None and speed is None:
        return Pace(count, fps, float(steps.mean() * fps))
    speed = speed or 1.0
    fps = fps or max(1.0, min(FASTEST, speed / float(np.median(steps))))
    shown = times[0] + np.arange(0, (times[-1] - times[0]) * (1 + 1e-9) + speed / fps / 2, speed / fps)
    return Pace(abs(shown[:, None] - times).argmin(axis=1), fps, speed)


def write_film(
    subject: Subject, path: Path, frames: Sequence[int], style: Style, pace: Pace, turns: float = 0.0,
    reference: Result | None = None,
) -> None:  # fmt: skip
    """Write a film of these frames at a pace; from start to end the eye goes so many times around the body.

    Raises InputError where it cannot be drawn or written.
    """
    played = [frames[number] for number in pace.numbers]
    seen = survey(subject, played, style, reference)
    shots = shots_of(subject, played, seen, turns)
    if 0 < pace.seconds < SHORT and pace.speed:
        slower = pace.speed * pace.seconds / 5
        log.info("this film takes %.2g s: --speed %.1g makes it 5 s long", pace.seconds, slower)
    with written(path, style.size or SIZE, pace.fps) as add:
        for picture in _pictures(subject, shots, seen, style, pace.speed):
            add(picture)


def _pictures(subject: Subject, shots: list[Shot], seen: Survey, style: Style, speed: float) -> Iterator[np.ndarray]:
    """Yield the picture (height, width, 3) of each shot; of equal ones in a row the first is drawn only."""
    width, height = style.size or SIZE
    low, high, depth = room_of(shots, seen, LABELS if style.axes else MARGIN)
    entries = entries_of(subject.scene, seen.fixed, [shot.overlays for shot in shots], seen.colouring, style.shown)
    letters = min(1.0, max(height / SIZE[1], SMALLEST))
    bar = [Entry("length", "")] if style.scale_bar else []
    stage_height = height - len(legend_picture([*entries, *bar], width, letters))
    caption = letters * CAPTION
    scale = min(width / (high - low)[0], (stage_height - caption) / (high - low)[1])  # [px/m]
    if scale <= 0:
        raise InputError(f"--size {width}x{height}: too small for caption and legend")
    bar = [scale_bar(scale / letters, width / letters / 5)] if style.scale_bar else []
    legend = legend_picture([*entries, *bar], width, letters)
    across, upward = (low + high) / 2 - [0, caption / 2 / scale]
    middle = seen.box.mean(axis=0)
    cut = cut_open(subject, seen.camera, style.shown) if style.shown else None
    before: Shot | None = None
    picture = np.empty(0)
    with Stage(width, stage_height, subject.triangles, letters) as stage:
        for shot in counted(shots, "pictures"):
            if before is None or shot.index != before.index or shot.camera is not before.camera:
                camera = shot.camera
                centre = across * camera.right + upward * camera.upward + middle @ camera.to_eye * camera.to_eye
                stage.face(camera, centre, stage_height / scale, depth)
                fabric = cut.fabric(subject.nodes(shot.index)) if cut else ()
                picture = np.concatenate([stage.picture(_panel(subject, shot, seen, style, fabric, speed)), legend])
            before = shot
            yield picture


def _panel(subject: Subject, shot: Shot, seen: Survey, style: Style, fabric: tuple[Fabric, ...], speed: float) -> Panel:
    """Return the panel of a shot, with its time and how much slower or faster than real it goes."""
    pace = (
        "" if speed in (0.0, 1.0) else f"{speed:.3g} times real time" if speed > 1 else f"{1 / speed:.3g} times slower"
    )
    return Panel(
        points=subject.surface(shot.index),
        fixed=subject.fixed(shot.index),
        overlays=shot.overlays,
        caption=(f"t = {subject.times[shot.index]:.3f} s", pace),
        colours=seen.colouring.rgb(shot.index) if seen.colouring else None,
        fabric=fabric,
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
