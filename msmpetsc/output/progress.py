"""How far a run is: a bar on a terminal, now and then a plain line in a batch log."""

import sys
import time
from contextlib import ExitStack
from typing import TextIO

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from msmpetsc.comm import log
from msmpetsc.model.frame import Frame

LINE_EVERY = 10.0  # [s] at the least between two lines of a log


class Progress:
    """Tell of each frame of a run of `total` steps; give `enabled` on rank 0 alone.

    Used as: update(frame) for every frame, frame 0 included; close() at the end, whatever the end.
    """

    def __init__(self, total: int, enabled: bool = True, stream: TextIO | None = None):
        self._total = total
        self._enabled = enabled
        self._stream = stream or sys.stderr
        self._bar: tqdm | None = None
        self._redirected = ExitStack()  # log lines, above the bar
        if enabled and self._stream.isatty():
            self._bar = tqdm(total=total, unit="frame", file=self._stream, dynamic_ncols=True, smoothing=0.1)
            self._redirected.enter_context(logging_redirect_tqdm([log]))
        self._begun: tuple[float, int] | None = None  # when the first frame came [s], and its index
        self._told = 0.0  # when the last line was printed [s]
        self._untold: Frame | None = None  # the newest frame, if it had no line

    def update(self, frame: Frame) -> None:
        """`frame` is done."""
        if not self._enabled:
            return
        if self._bar is not None:
            self._bar.set_postfix_str(_solver(frame), refresh=False)
            self._bar.update(frame.index - self._bar.n)
            return
        now = time.monotonic()
        first = self._begun is None
        if first:
            self._begun = now, frame.index
        if first or frame.index == self._total or now - self._told >= LINE_EVERY:
            self._tell(frame, now)
        else:
            self._untold = frame

    def close(self) -> None:
        """Leave the bar as it is, or tell of the last frame if that had no line."""
        self._redirected.close()
        if self._bar is not None:
            self._bar.close()
        elif self._untold is not None:
            self._tell(self._untold, time.monotonic())

    def _tell(self, frame: Frame, now: float) -> None:
        parts = [f"frame {frame.index}/{self._total}", f"t = {frame.time:.3f} s"]
        begun, first = self._begun
        if frame.index > first and now > begun:
            rate = (frame.index - first) / (now - begun)
            parts += [f"{rate:.3g} frames/s", f"{duration((self._total - frame.index) / rate)} left", _solver(frame)]
        print("  ".join(parts), file=self._stream, flush=True)
        self._told, self._untold = now, None


def _solver(frame: Frame) -> str:
    return f"its {frame.ksp_its}  error {frame.step_error:.1e}"


def duration(seconds: float) -> str:
    """31 s, 12 min, 3.4 h."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
