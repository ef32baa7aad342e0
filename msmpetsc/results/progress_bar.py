"""The progress of a run: a bar on a terminal, a line now and then in a batch log."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any, TypeVar

from tqdm import tqdm
from tqdm.contrib.logging import tqdm_logging_redirect

from msmpetsc.comm import log
from msmpetsc.fields import Frame

Item = TypeVar("Item")
LINE_EVERY = 10.0  # [s] at the least between two lines of a log
LINE = "frame {n_fmt}/{total_fmt}  {rate_fmt}  {remaining} left{postfix}"


class BatchLog:
    """Standard error of a batch job, where each state of a bar is a line."""

    def write(self, text: str) -> None:
        """Write a line, without what a bar does to a terminal's cursor."""
        if text.strip():
            print(text.strip(), file=sys.stderr)


class Progress:
    """The progress of a run of `total` steps, shown frame by frame; enabled on rank 0 alone.

    Call update(frame) for every frame, frame 0 included, and close() at the end, whatever the end.
    """

    def __init__(self, total: int, enabled: bool = True):
        self._enabled = enabled
        self._is_terminal = sys.stderr.isatty()
        style: dict[str, Any] = dict(dynamic_ncols=True, smoothing=0.1)
        if not self._is_terminal:
            style = dict(bar_format=LINE, file=BatchLog(), mininterval=LINE_EVERY)
        self._style = style | dict(total=total, unit="frame", miniters=1)
        self._shown = ExitStack()  # the bar, with log lines above it
        self._bar: tqdm | None = None

    def update(self, frame: Frame) -> None:
        """Show that a frame is done."""
        if not self._enabled:
            return
        if self._bar is None:  # whose rate counts from the first frame of a run that goes on
            bar = tqdm_logging_redirect(initial=frame.index, loggers=[log], **self._style)
            self._bar = self._shown.enter_context(bar)
        self._bar.set_postfix_str(
            f"its {frame.ksp_its}  error {frame.step_error:.1e}", refresh=False
        )
        self._bar.update(frame.index - self._bar.n)

    def close(self) -> None:
        """End the bar, and print the last frame if it had no line."""
        if self._bar is not None:
            self._bar.leave = self._is_terminal or self._bar.last_print_n < self._bar.n
        self._shown.close()


def duration(seconds: float) -> str:
    """Return a duration in words: 3.1 s, 31 s, 12 min, 3.4 h."""
    if seconds < 120:
        return f"{seconds:.{int(seconds < 10)}f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def counted(items: Sequence[Item], unit: str) -> Iterator[Item]:
    """Yield the items, with a bar on a terminal that disappears at the end."""
    yield from tqdm(items, unit=f" {unit}", disable=None, leave=False, dynamic_ncols=True)
