"""Choose frames of a result by numbers and slices in Python's notation: "0,10:250:5,-1"."""

from collections.abc import Sequence

from msmpetsc.errors import InputError

Frames = Sequence[int | slice]


def frames_in(text: str) -> Frames:
    """Return the numbers and slices in a text like "0,10:250:5". Raises InputError."""
    try:
        return [_slice(part) if ":" in part else int(part) for part in text.split(",")]
    except ValueError:
        raise InputError(
            f"--frames takes numbers like 0,10,20 or slices like 0:250:5, not {text!r}"
        ) from None


def _slice(text: str) -> slice:
    """Return the slice for a text like "0:250:5". Raises ValueError."""
    numbers = [int(word) if word else None for word in text.split(":")]
    if len(numbers) > 3 or numbers[2:] == [0]:
        raise ValueError(text)
    return slice(*numbers)


def frames_of(path: str, frames: Frames, total: int) -> list[int]:
    """Return the numbers of the chosen frames among ``total`` frames.

    Raises InputError if a frame does not exist, or none is chosen.
    """
    numbers = range(total)
    chosen: list[int] = []
    for part in frames:
        if not isinstance(part, slice) and not -total <= part < total:
            raise InputError(f"{path} has frames 0 to {total - 1}, not {part}")
        chosen += numbers[part] if isinstance(part, slice) else [numbers[part]]
    if not chosen:
        raise InputError(f"{path} has frames 0 to {total - 1}, of which --frames names none")
    return chosen
