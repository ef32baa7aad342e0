"""Nodes that a scene leads along a path, and lets go."""

from dataclasses import dataclass

import numpy as np

from msmpetsc.model.paths import Path, within


@dataclass(frozen=True)
class Anchor:
    """where (l,) bool: the nodes, ghosts included; they follow ``path`` while time < stop [s], None: always."""

    where: np.ndarray
    path: Path
    stop: float | None

    def holds_at(self, time: float) -> bool:
        return within(time, 0.0, self.stop)
