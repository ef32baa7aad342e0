"""Two runs of one lattice held against each other, frame by frame, without MPI and without PETSc.

An error is the greatest difference at a frame over the scale of its field, which is the same for all frames:

    position, surface                       the largest displacement from rest, at least 1e-6 of the body's longest side
    kinetic, elastic, potential, contact    the largest |energy| among these, the potential one counted from its start;
                                            at least that of the stiffest spring strained by 1e-6
    momentum                                sqrt(2 m K) of the whole mass m, K the largest kinetic energy or that least one
    anything else                           its own largest |value|

each over both runs and all frames compared. What the digits of the coarser of the two stored types cannot tell apart
is equal, and so are two NaN, or two infinities of one sign.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.output.reader import Result

ENERGIES = ("kinetic", "elastic", "potential", "contact")
DEFAULT = ("position", "surface", *ENERGIES, "momentum")
AT_REST = {"position": ("lattice", "nodes"), "surface": ("surface", "points")}
LEAST_STRAIN = 1e-6  # of the body or of a spring: less is rounding
SAME_PLACE = 1e-6  # of a cell
SAME_TIME = 1e-6  # of the spacing of frames


@dataclass
class Field:
    """How far one field is apart.

    scale  : what errors are relative to
    errors : (p,) relative, one a frame compared; inf where only one run has a number
    worst  : (p,) the row, node or point, that is farthest apart; 0 for plain numbers
    """

    name: str
    unit: str
    scale: float = 0.0
    errors: np.ndarray = field(default_factory=lambda: np.empty(0))
    worst: np.ndarray = field(default_factory=lambda: np.empty(0, int))

    def first_above(self, rtol: float) -> int | None:
        """Where in the frames compared an error is first above rtol."""
        above = np.flatnonzero(self.errors > rtol)
        return int(above[0]) if len(above) else None


@dataclass
class Comparison:
    """pairs (p, 2): frames of equal time in the one and the other run. left_out: fields that one run alone has."""

    pairs: np.ndarray
    times: np.ndarray  # (p,) [s]
    fields: list[Field]
    left_out: list[str]


@np.errstate(all="ignore")  # what overflows differs, and is told of as that
def compare(one: Result, other: Result, names: Sequence[str] | None = None) -> Comparison:
    """Compare the fields `names` of two runs at the times that both have, or those of DEFAULT that both have.

    Raises InputError if the lattices do not match, or the runs have no time or not these fields.
    """
    refuse_other_lattice(one, other)
    chosen, left_out = _chosen(one, other, names)
    times = one.frames.time[:]
    pairs = common_times(times, other.frames.time[:])
    if not len(pairs):
        raise InputError(f"{one.path} and {other.path} have no finished frame of the same time")
    measured = {name: _measure(one, other, name, pairs) for name in chosen}
    scales = _scales(one, other, measured, pairs)
    fields = []
    for name, (apart, worst, _) in measured.items():
        with np.errstate(divide="ignore", invalid="ignore"):
            errors = np.where(apart == 0, 0.0, apart / scales[name])
        fields.append(Field(name, one.frames[name].unit, scales[name], errors, worst))
    return Comparison(pairs, times[pairs[:, 0]], fields, left_out)


def _chosen(one: Result, other: Result, names: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """Fields to compare, and those of DEFAULT that only one run has."""
    shared = [name for name in one.frames if name in other.frames and name != "time"]
    if names is None:
        either = [name for name in DEFAULT if name in one.frames or name in other.frames]
        return [n for n in either if n in shared], [n for n in either if n not in shared]
    for name in names:
        if name not in shared:
            raise InputError(f"{one.path} and {other.path} do not both have frames/{name}{did_you_mean(name, shared)}")
    return list(dict.fromkeys(names)), []


def _measure(one: Result, other: Result, name: str, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Of each pair the greatest distance of two rows and its row, (p,) each; and the greatest size in any frame.

    The size is the distance from rest where the field is one of places.
    """
    mine, its = one.frames[name], other.frames[name]
    if mine.shape[1:] != its.shape[1:]:
        raise InputError(f"frames/{name} is {mine.shape[1:]} a frame in {one.path}, {its.shape[1:]} in {other.path}")
    group, stored = AT_REST.get(name, (None, None))
    rest = getattr(one, group).get(stored, None) if group else None
    rest = 0.0 if rest is None else rest[:]
    digits = max(np.finfo(array.dtype).eps if array.dtype.kind == "f" else 0.0 for array in (mine, its))
    apart, worst, largest = np.empty(len(pairs)), np.empty(len(pairs), int), 0.0
    for place, (here, there) in enumerate(pairs):
        a, b = (np.asarray(rows, float) for rows in (mine[here], its[there]))
        distance = _row_lengths(difference(a, b, digits))
        worst[place] = np.argmax(distance) if distance.size else 0
        apart[place] = distance[worst[place]] if distance.size else 0.0
        for rows in (a, b):
            sizes = _row_lengths(rows - rest)
            largest = max(largest, sizes[np.isfinite(sizes)].max(initial=0.0))
    return apart, worst, float(largest)


def difference(a: np.ndarray, b: np.ndarray, digits: float) -> np.ndarray:
    """|a - b| less what rounding to these relative `digits` may do; 0 of two NaN, inf of a NaN and a number."""
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.abs(a - b) - digits * np.maximum(np.abs(a), np.abs(b))
    apart = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, apart)
    return np.maximum(np.where(np.isnan(apart), np.inf, apart), 0.0)


def _row_lengths(rows: np.ndarray) -> np.ndarray:
    """(r,) lengths of vectors (r, 3) or of one (3,), or sizes of plain numbers."""
    if rows.ndim == 0:
        return np.abs(rows)[None]
    with np.errstate(over="ignore", invalid="ignore"):
        return np.atleast_1d(np.linalg.norm(rows, axis=-1)).ravel()


def _scales(one: Result, other: Result, measured: dict, pairs: np.ndarray) -> dict[str, float]:
    largest = {name: size for name, (_, _, size) in measured.items()}
    size = np.ptp(one.lattice.nodes[:], axis=0).max() if len(one.lattice.nodes) else 0.0
    places = {name: max(largest[name], LEAST_STRAIN * size) for name in AT_REST if name in largest}
    least = _least_energy(one)
    energy, kinetic = (max(least, _largest(one, other, pairs, names)) for names in (ENERGIES, ["kinetic"]))
    scales = largest | places | dict.fromkeys(largest.keys() & set(ENERGIES), energy)
    if "momentum" in largest and "mass" in one.lattice and kinetic > 0:
        scales["momentum"] = float(np.sqrt(2 * one.lattice.mass[:].sum() * kinetic))
    return scales


def _largest(one: Result, other: Result, pairs: np.ndarray, names: Sequence[str]) -> float:
    """The largest size of these energies at the frames compared, of both runs."""
    runs = (one, pairs[:, 0]), (other, pairs[:, 1])
    found = [(name, run.frames[name][frames]) for run, frames in runs for name in names if name in run.frames]
    # the potential energy's zero means nothing
    values = [energy - energy[0] if name == "potential" else energy for name, energy in found]
    values = np.abs(np.concatenate([np.empty(0), *values]))
    return float(values[np.isfinite(values)].max(initial=0.0))


def _least_energy(run: Result) -> float:
    """[J] 1/2 k (LEAST_STRAIN r)^2 of the stiffest and longest spring; 0 where the file has no springs."""
    if not all(name in run.lattice and len(run.lattice[name]) for name in ("stiffness", "rest_length")):
        return 0.0
    return float(0.5 * run.lattice.stiffness[:].max() * (LEAST_STRAIN * run.lattice.rest_length[:].max()) ** 2)


def refuse_other_lattice(one: Result, other: Result) -> None:
    """Raise InputError with the first reason why the two are not of one lattice."""

    def refuse(reason: str) -> None:
        raise InputError(f"{one.path} and {other.path} are runs of different lattices: {reason}")

    nodes, its = one.lattice.nodes[:], other.lattice.nodes[:]
    sizes = cell_size(one, nodes), cell_size(other, its)
    if len(nodes) != len(its):
        refuse(f"{len(nodes)} and {len(its)} nodes, cells of {sizes[0]:.4g} m and {sizes[1]:.4g} m")
    if abs(sizes[0] - sizes[1]) > SAME_PLACE * sizes[0]:
        refuse(f"cells of {sizes[0]:.6g} m and {sizes[1]:.6g} m")
    same = np.linalg.norm(nodes - its, axis=1) <= SAME_PLACE * (sizes[0] or 1.0)
    if not same.all():
        node = int(np.argmin(same))
        refuse(f"node {node} rests at {place(nodes[node])} in one, at {place(its[node])} in the other")
    if "springs" not in one.lattice or "springs" not in other.lattice:
        return
    springs, its = one.lattice.springs[:], other.lattice.springs[:]
    if len(springs) != len(its):
        refuse(f"{len(springs)} and {len(its)} springs")
    if not np.array_equal(springs, its) and not np.array_equal(_sorted(springs), _sorted(its)):
        refuse("their springs join other nodes")


def cell_size(run: Result, nodes: np.ndarray) -> float:
    """Edge of a cell [m], from the first; 0 where the file has none."""
    if "cells" not in run.lattice or not len(run.lattice.cells):
        return 0.0
    corners = run.lattice.cells[0].astype(np.int64)
    if corners.min() < 0 or corners.max() >= len(nodes):
        raise InputError(f"{run.path} is damaged: its first cell has corner {corners.max()} of {len(nodes)} nodes")
    return float(np.ptp(nodes[corners], axis=0).max())


def place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in point) + ") m"


def _sorted(springs: np.ndarray) -> np.ndarray:
    """Their order in the file depends on the number of ranks."""
    springs = np.sort(springs, axis=1)
    return springs[np.lexsort(springs.T)]


def common_times(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Indices (p, 2) of equal times in two ascending series [s], equal to rounding."""
    if not len(times) or not len(others):
        return np.empty((0, 2), int)
    slack = SAME_TIME * min((np.diff(others).min() if len(others) > 1 else 1.0), 1.0)
    right = np.searchsorted(others, times).clip(1, max(1, len(others) - 1))
    near = np.where(np.abs(others[right - 1] - times) <= np.abs(others[right % len(others)] - times), right - 1, right)
    near = near.clip(0, len(others) - 1)
    same = np.abs(others[near] - times) <= slack
    return np.column_stack([np.nonzero(same)[0], near[same]])
