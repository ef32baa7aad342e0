"""How fast a film or a page goes: how many simulated seconds a second, and which frame each picture shows."""

from dataclasses import dataclass

import numpy as np

from msmpetsc.errors import InputError

FASTEST = 30.0  # pictures a second, where nothing is said
LENGTHS = 3.0, 8.0  # [s] that a film lasts, where nothing is said
STEPS = (1, 2, 5)  # times powers of ten: how much slower or faster


@dataclass(frozen=True)
class Playback:
    """How fast a film goes.

    numbers : which of the frames each picture shows
    fps     : pictures a second
    speed   : simulated seconds a second; 0 where time stands still
    turns   : how often the eye goes around the body
    """

    numbers: np.ndarray
    fps: float
    speed: float
    turns: float = 0.0

    @property
    def words(self) -> str:
        """How fast time goes: "10 times slower than real"; "" where it goes as it does."""
        if self.speed in (0.0, 1.0):
            return ""
        if self.speed < 1:
            return f"{1 / self.speed:.3g} times slower than real"
        return f"{self.speed:.3g} times faster than real"


def usual_speed(span: float) -> float:
    """Return the simulated seconds a second at which a span [s] takes 3 to 8 s: 1, or what is round and nearest."""
    if not 0 < span < np.inf:
        return 1.0
    factors = np.outer(10.0 ** np.arange(20), STEPS).ravel()
    least, most = LENGTHS
    if span < least:
        return float(1 / factors[np.argmax(span * factors >= least)])
    return float(factors[np.argmax(span / factors <= most)])


def playback_of(times: np.ndarray, fps: float | None = None, speed: float | None = None) -> Playback:
    """Return the playback of frames at these times (k,) [s].

    So that it lasts 3 to 8 s unless fps or speed says otherwise. With fps alone every frame is one picture; with both,
    or speed, each picture shows the frame nearest to its time. Raises InputError where time does not go on.
    """
    count = np.arange(len(times))
    steps = np.diff(times)
    if len(times) == 1 or not (steps > 0).all():
        if speed is not None:
            raise InputError("--speed needs frames in order of time, more than one")
        return Playback(count, fps or FASTEST / 3, 0.0)
    if fps is not None and speed is None:
        return Playback(count, fps, float(steps.mean() * fps))
    speed = speed or usual_speed(float(times[-1] - times[0]))
    fps = fps or max(1.0, min(FASTEST, speed / float(np.median(steps))))
    shown = times[0] + np.arange(0, (times[-1] - times[0]) * (1 + 1e-9) + speed / fps / 2, speed / fps)
    return Playback(abs(shown[:, None] - times).argmin(axis=1), fps, speed)
