"""Damage to bytes, and the outcomes that the tests of bad input allow."""

import re
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from msmpetsc.errors import InputError

# The trials are the same every time, so a fault found once is found again.
TRIALS = settings(
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
NUMBERS = [*b"nan inf 1e400 -1 0 1000000000000 18446744073709551616 1e12 x 1/2/3".split(), b""]
NUMBER = re.compile(rb"[-+]?\d[\d.eE+-]*")
# limits of time [s] and memory [byte]; a trial takes a hundredth of them
SECONDS, BYTES = 10, 2**31

place = st.floats(0, 1, exclude_max=True)
damage = st.lists(
    st.one_of(
        st.tuples(st.just("byte"), place, st.binary(min_size=1, max_size=1)),
        st.tuples(st.just("number"), place, st.sampled_from(NUMBERS)),
        st.tuples(
            st.just("bytes"),
            place,
            st.sampled_from([b"\xff" * 4, b"\xff" * 8, b"\0" * 8, b"\0\xca\x9a\x3b"]),
        ),
        st.tuples(st.just("put in"), place, st.binary(max_size=8)),
        st.tuples(st.just("cut"), place, st.just(b"")),
    ),
    min_size=1,
    max_size=4,
)


def damaged(content: bytes, changes: list[tuple[str, float, bytes]]) -> bytes:
    """Return the bytes after these changes; places are shares of the length or of the numbers."""
    for kind, where, new in changes:
        at = int(where * len(content))
        if kind == "number" and (found := list(NUMBER.finditer(content))):
            hit = found[int(where * len(found))]
            content = content[: hit.start()] + new + content[hit.end() :]
        elif kind == "cut":
            content = content[:at]
        else:
            content = content[:at] + new + content[at + (0 if kind == "put in" else len(new)) :]
    return content


@contextmanager
def limits() -> Iterator[None]:
    """Limit time and memory within the context; a test that exceeds a limit fails."""

    def too_long(*_):
        raise AssertionError(f"takes more than {SECONDS} s")

    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (now + BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def refusal(call: Callable, lines: bool = False) -> str:
    """Return the message of the InputError that a call raises; an empty string if it succeeds.

    The message must be one line that a terminal can show.
    """
    with limits():
        try:
            call()
        except InputError as error:
            told = str(error).split("\n") if lines else [str(error)]
            assert all(line.isprintable() and len(line) < 600 for line in told), told
            return str(error)
    return ""
