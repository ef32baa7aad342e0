"""The result file of a run that goes on: the file that is there, or a new one that takes its frames over."""

from pathlib import Path

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.output.reader import checked_dataset, damage_told, finished, open_result
from msmpetsc.output.writer import ResultFile, open_again, refuse_small_disk


class InPlace(ResultFile):
    """The file as it lies there, laid out for all frames: nothing but numbers in their places is written, so it is as
    safe as it was. Frames that it has already are not written again."""

    def write(self, name: str, rows: np.ndarray) -> None:
        """It is there. Raises InputError where it is not."""
        rows = np.asarray(rows)
        count = self._comm.allreduce(len(rows))
        with self._together():
            if self._file is not None:
                shape = checked_dataset(self.path, self._file, name).shape
                if shape != (count, *rows.shape[1:]):
                    raise InputError(f"{self.path} is damaged: {name} has shape {shape}")

    def _refuse_to_replace(self) -> None:
        pass

    def _create(self, _: dict) -> None:
        try:
            open_result(self.path).close()
            self._file = open_again(self.path)
        except Exception:
            self._lock.free()
            raise

    def _start(self, count: int) -> None:
        for name, shape, _, dtype, _ in self._layout(count):
            found = self._file.get(name)
            if found is None or found.shape != shape or found.dtype != np.dtype(dtype):
                raise InputError(f"{self.path} has no room for {name} as it is now: --force writes the file anew")
        there = self.path.stat()
        refuse_small_disk(self.path, there.st_size - there.st_blocks * 512)  # what has no place on the disk yet
        self.finished = finished(self._file)

    def _publish(self) -> None:
        pass


class Anew(ResultFile):
    """A new file with the first ``frames`` of the earlier one, which it replaces when it has them and a checkpoint."""

    def __init__(self, path: Path, comm, attributes: dict, frames: int):
        self._frames = frames
        super().__init__(path, comm, attributes, overwrite=True)

    def keep(self, frames: int) -> None:
        """No more than so many."""
        self._frames = min(self._frames, frames)

    def _start(self, count: int) -> None:
        super()._start(count)
        with open_result(self.path) as earlier:
            names = earlier["frames"].keys() & self._file["frames"].keys()
            there = {name: checked_dataset(self.path, earlier, f"frames/{name}") for name in sorted(names)}
            for name, dataset in there.items():
                if dataset.shape[1:] != self._file["frames"][name].shape[1:]:
                    raise InputError(f"{self.path} is damaged: frames/{name} has shape {dataset.shape}")
            for index in range(self._frames):
                for name, dataset in there.items():
                    with damage_told(self.path):
                        row = dataset[index]
                    self._file["frames"][name][index] = row
        self.finished = self._frames

    def _take_over(self, saved: Checkpoint | None) -> None:
        if saved is not None:
            self.write_checkpoint(saved)
