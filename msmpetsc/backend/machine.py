"""The machine that a program runs on, and the memory that it takes of it."""

import platform
from pathlib import Path
from typing import Any

import psutil


def machine() -> dict[str, Any]:
    """Return processor, cores, memory [byte] and system."""
    path = Path(
        "/proc/cpuinfo"
    )  # where Linux has the model's name: Python's platform does not look there
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


def peak_memory() -> int:
    """Return the most memory of this process that ever was resident [byte].

    getrusage counts that of its parent, too, as it was when this process was started; the kernel's own count does not.
    """
    lines = Path("/proc/self/status").read_text().splitlines() if psutil.LINUX else []
    peaks = [int(line.split()[1]) for line in lines if line.startswith("VmHWM:")]
    return 1024 * peaks[0] if peaks else psutil.Process().memory_info().rss
