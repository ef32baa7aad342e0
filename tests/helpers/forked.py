"""The program on one rank without its start: a process that has imported it forks a child for each run.

A start takes 2 s of a core, a fork 0.4 s. What several ranks do, and what starts by itself, has a real mpiexec.
"""

import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from msmpetsc.study.forkserver import Forked


def run_forked(arguments: Sequence[str], environment: Mapping[str, str], timeout: float) -> subprocess.CompletedProcess:
    """``msmpetsc`` with these arguments, as subprocess.run gives it. Raises subprocess.TimeoutExpired."""
    with tempfile.TemporaryDirectory() as folder:
        out, error = Path(folder, "out"), Path(folder, "error")
        child = Forked(arguments, out, environment, error)
        try:
            status = child.wait(timeout)
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)  # its session: what it started, too
            raise
        return subprocess.CompletedProcess(list(arguments), status, out.read_text(), error.read_text())
