"""How far a run is: a bar on a terminal, now and then a plain line in a batch log."""

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any, TextIO, TypeVar

from tqdm import tqdm
from tqdm.contrib.logging import tqdm_logging_redirect

from msmpetsc.comm import log
from msmpetsc.fields import Frame

Item = TypeVar("Item")
LINE_EVERY = 10.0  # [s] at the least between two lines of a log


class Progress:
    """The progress of a run of `total` steps, shown frame by frame; enabled on rank 0 alone.

    Call update(frame) for every frame, frame 0 included, and close() at the end, whatever the end.
    """

    def __init__(self, total: int, enabled: bool = True, stream: TextIO | None = None):
        self._total = total
        self._enabled = enabled
        self._stream = stream or sys.stderr
        self._bar: tqdm | None = None
        self._shown = ExitStack()  # the bar, with log lines above it
        if enabled and self._stream.isatty():
            style: dict[str, Any] = dict(unit="frame", file=self._stream, dynamic_ncols=True, smoothing=0.1)
            self._bar = self._shown.enter_context(tqdm_logging_redirect(total=total, loggers=[log], **style))
        self._begun: tuple[float, int] | None = None  # when the first frame came [s], and its index
        self._printed = 0.0  # when the last line was printed [s]
        self._unprinted: Frame | None = None  # the newest frame, if it had no line

    def update(self, frame: Frame) -> None:
        """Show that `frame` is done."""
        if not self._enabled:
            return
        if self._bar is not None:
            self._bar.set_postfix_str(_solver(frame), refresh=False)
            self._bar.update(frame.index - self._bar.n)
            return
        now = time.monotonic()
        begun = self._begun or (now, frame.index)
        if self._begun is None or frame.index == self._total or now - self._printed >= LINE_EVERY:
            self._print(frame, now, *begun)
        else:
            self._unprinted = frame
        self._begun = begun

    def close(self) -> None:
        """Leave the bar as it is, or print the last frame if that had no line."""
        self._shown.close()
        if self._unprinted is not None and self._begun is not None:
            self._print(self._unprinted, time.monotonic(), *self._begun)

    def _print(self, frame: Frame, now: float, begun: float, first: int) -> None:
        parts = [f"frame {frame.index}/{self._total}", f"t = {frame.time:.3f} s"]
        if frame.index > first and now > begun:
            rate = (frame.index - first) / (now - begun)
            parts += [f"{rate:.3g} frames/s", f"{duration((self._total - frame.index) / rate)} left", _solver(frame)]
        print("  ".join(parts), file=self._stream, flush=True)
        self._printed, self._unprinted = now, None


def _solver(frame: Frame) -> str:
    return f"its {frame.ksp_its}  error {frame.step_error:.1e}"


def duration(seconds: float) -> str:
    """Return a time for people: 31 s, 12 min, 3.4 h."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def counted(items: Sequence[Item], unit: str) -> Iterator[Item]:
    """Yield the items, with a bar on a terminal that goes away with the last of them."""
    yield from tqdm(items, unit=f" {unit}", disable=None, leave=False, dynamic_ncols=True)
