"""Check communication and partition against plain arrays that every rank knows in full.

test_comm.py runs this worker under mpiexec.
"""

import numpy as np
from mpi4py import MPI

from msmpetsc.comm import Route, on_root, together
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.geometry.partition import SortedKeys

comm = MPI.COMM_WORLD


def same(found: np.ndarray, expected: np.ndarray) -> None:
    assert found.dtype == expected.dtype and np.array_equal(found, expected), (
        comm.rank,
        found,
        expected,
    )


def check_route(rng: np.random.Generator, rows: int, senders: int) -> None:
    """Check that ``rows`` of the first ``senders`` ranks reach any rank and are answered.

    Rows have several types.
    """
    holder = np.sort(rng.integers(0, senders, rows))
    destination = rng.integers(0, comm.size, rows)
    number = np.arange(rows)
    mine, here = holder == comm.rank, destination == comm.rank
    route = Route(comm, destination[mine])
    for whole in (
        number,
        number > 3,
        number.astype(np.uint8),
        rng.random((rows, 3)),
        rng.random((rows, 2, 2)),
    ):
        # holders are sorted by sender, then in order
        same(route.send(whole[mine]), whole[here])
        # answers may differ in shape from the rows
        same(route.answer(whole[here][..., None]), whole[mine][..., None])


def check_sorted_keys(rng: np.random.Generator, count: int, holders: int, limit: int) -> None:
    """Check numbers of keys that repeat within and between ranks."""
    given = rng.integers(0, limit, count)
    holder = rng.integers(0, holders, count)
    table = SortedKeys(comm, np.sort(given[holder == comm.rank]))
    plain = np.unique(given)
    assert table.total == len(plain)
    same(table.keys, plain[table.first : table.first + len(table.keys)])
    # no key is on two ranks, and none is lost
    assert comm.allreduce(len(table.keys)) == table.total
    asked = np.concatenate([given, rng.integers(-1, limit, count + 2)])
    # ranks ask for different keys
    asked = asked[: len(asked) // 2 * 2].reshape(2, -1)[:, :: comm.rank + 1]
    expected = np.array(
        [[np.searchsorted(plain, key) if key in plain else -1 for key in row] for row in asked]
    )
    same(table.find(asked), expected.reshape(asked.shape).astype(np.int64))
    starts = np.array(comm.allgather(table.first))
    index = np.arange(table.total)
    same(table.owner_of_index(index), np.searchsorted(starts, index, side="right") - 1)
    same(table.owner(plain), table.owner_of_index(index))


def check_shares_are_even(rng: np.random.Generator) -> None:
    """Check that parts end even within a few per cent if a single rank has all keys."""
    given = np.unique((rng.random(40_000) ** 4 * 1e12).astype(np.int64))
    table = SortedKeys(comm, given if comm.rank == comm.size - 1 else given[:0])
    assert len(table.keys) < 1.05 * len(given) / comm.size


def message_of(function) -> str:
    try:
        function()
    except InputError as error:
        return str(error)
    return "no error"


def check_together() -> None:
    def fail_on(ranks: list[int]) -> None:
        with together(comm):
            if comm.rank in ranks:
                raise InputError(f"of rank {comm.rank}")

    last = comm.size - 1
    assert message_of(lambda: fail_on([last])) == f"of rank {last}"
    assert message_of(lambda: fail_on(list(range(comm.size)))) == "of rank 0"
    assert message_of(lambda: fail_on([])) == "no error"
    try:
        with together(comm):
            raise StepFailed("keeps its class")
    except StepFailed as error:
        assert error.exit_status == 3


def check_on_root() -> None:
    called = []
    assert on_root(comm, lambda: called.append(comm.rank) or 7) == (7 if comm.rank == 0 else None)
    assert called == ([0] if comm.rank == 0 else [])

    def fail() -> None:
        raise InputError("of the root")

    assert message_of(lambda: on_root(comm, fail)) == "of the root"


if __name__ == "__main__":
    # the same numbers on every rank
    rng = np.random.default_rng(5)
    for rows in (0, 1, 5, 200):
        check_route(rng, rows, comm.size)
        check_route(rng, rows, 1)
    for count, limit in ((0, 1), (1, 1), (3, 100), (300, 50), (3000, 1 << 62)):
        check_sorted_keys(rng, count, comm.size, limit)
        check_sorted_keys(rng, count, 1, limit)
    check_shares_are_even(rng)
    check_together()
    check_on_root()
    print("passed", flush=True)
