"""The machine that a program runs on, as figures of cost are to be read with."""

import platform
from pathlib import Path
from typing import Any

import psutil


def processor() -> str:
    """Return the model of the processor, as the system names it."""
    path = Path("/proc/cpuinfo")  # where Linux has it: Python's platform does not look there
    lines = path.read_text().splitlines() if path.exists() else []
    models = (line.partition(": ")[2] for line in lines if line.startswith("model name"))
    return next(models, "") or platform.processor() or platform.machine()


def machine() -> dict[str, Any]:
    """Return processor, cores, memory [byte] and system."""
    memory = psutil.virtual_memory().total
    return {
        "cpu": processor(), "cores": psutil.cpu_count(), "memory": memory, "system": platform.platform(terse=True),
    }  # fmt: skip
