"""Show the progress of a run: a bar on a terminal, or a line now and then in a batch log."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any, TypeVar

from tqdm import tqdm
from tqdm.contrib.logging import tqdm_logging_redirect

from msmpetsc.comm import log
from msmpetsc.fields import Frame

Item = TypeVar("Item")
# least time between two lines of a log [s]; keeps the log of a long run short
LINE_EVERY = 10.0
LINE = "frame {n_fmt}/{total_fmt}  {rate_fmt}  {remaining} left{postfix}"


class BatchLog:
    """Standard error of a batch job: prints each state of the bar as a line."""

    def write(self, text: str) -> None:
        """Write a line, without the bar's control characters."""
        if text.strip():
            print(text.strip(), file=sys.stderr)


class Progress:
    """The progress of a run of ``total`` steps, shown frame by frame; enable it on rank 0 alone.

    Call update(frame) for every frame, frame 0 included, and close() at the end, on errors too.
    """

    def __init__(self, total: int, enabled: bool = True):
        self._enabled = enabled
        self._is_terminal = sys.stderr.isatty()
        style: dict[str, Any] = dict(dynamic_ncols=True, smoothing=0.1)
        if not self._is_terminal:
            style = dict(bar_format=LINE, file=BatchLog(), mininterval=LINE_EVERY)
        self._style = style | dict(total=total, unit="frame", miniters=1)
        # the bar, and the redirection of log lines above it
        self._shown = ExitStack()
        self._bar: tqdm | None = None

    def update(self, frame: Frame) -> None:
        """Show that a frame is finished."""
        if not self._enabled:
            return
        # created at the first frame, from where the rate of a resumed run counts
        if self._bar is None:
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
    """Return a duration [s] in words: 3.1 s, 31 s, 12 min, 3.4 h."""
    if seconds < 120:
        return f"{seconds:.{int(seconds < 10)}f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def counted(items: Sequence[Item], unit: str) -> Iterator[Item]:
    """Yield the items and show a bar on a terminal, which disappears at the end."""
    yield from tqdm(items, unit=f" {unit}", disable=None, leave=False, dynamic_ncols=True)
