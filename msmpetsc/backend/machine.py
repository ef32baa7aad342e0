"""The machine that a program runs on, and the memory of the process."""

import ctypes
import platform
from pathlib import Path
from typing import Any

import psutil


def machine() -> dict[str, Any]:
    """Return the machine's processor, cores, memory [byte] and system."""
    # Python's platform module does not read the processor's model name on Linux.
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    models = (line.partition(": ")[2] for line in lines if line.startswith("model name"))
    cpu = next(models, "") or platform.processor() or platform.machine()
    memory = psutil.virtual_memory().total
    return {
        "cpu": cpu,
        "cores": psutil.cpu_count(),
        "memory": memory,
        "system": platform.platform(terse=True),
    }


def return_free_memory() -> None:
    """Return freed memory to the system.

    Open MPI sets glibc's allocator so that freed memory stays in the process.
    """
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).malloc_trim(0)


def peak_memory() -> int:
    """Return the peak resident memory of this process [byte].

    On Linux it is VmHWM, because getrusage would include the peak of the parent process. On other
    systems it is the present memory.
    """
    lines = Path("/proc/self/status").read_text().splitlines() if psutil.LINUX else []
    peaks = [int(line.split()[1]) for line in lines if line.startswith("VmHWM:")]
    return 1024 * peaks[0] if peaks else psutil.Process().memory_info().rss
