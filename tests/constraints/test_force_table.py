"""Forces that change with time by a table, `total = { times, values }`, linear in between."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene, play
from one_process import input_error

from msmpetsc.constraints.time_functions import Lines
from msmpetsc.environment import Environment
from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene

# [s]: a binary fraction, so that steps end exactly at the times of the table
STEP = 1 / 64
ALL = {"half_space": {"point": [0, 0, 0], "normal": [0, 0, 1]}}
FOOT = {"half_space": {"point": [0, 0, 0], "normal": [0, 0, -1]}}
TABLE = {"times": [2 * STEP, 4 * STEP, 7 * STEP], "values": [[0, 0, 0], [8, 0, -40], [8, 4, 0]]}


def total(time: float) -> np.ndarray:
    return np.array(
        [np.interp(time, TABLE["times"], along) for along in np.transpose(TABLE["values"])]
    )


def pulled(folder: Path, table=TABLE, steps: int = 10, **tables) -> Path:
    """Return the scene of a block whose nodes are all pulled; ``time`` adds to its time table."""
    time = {"step": STEP, "duration": steps * STEP} | tables.pop("time", {})
    return block_scene(folder, time=time, force=[{"region": ALL, "total": table}], **tables)


def test_statics_find_the_state_of_each_time_and_the_same_load_once(tmp_path: Path):
    held = {"pin": [{"region": FOOT}], "time": {"integrator": "static"}}
    _, frames = play(pulled(tmp_path, steps=9, **held))
    _, (_, plain) = play(pulled(tmp_path, list(total(3 * STEP)), 1, **held))
    moved = np.abs(plain.position - frames[0].position).max()
    np.testing.assert_allclose(frames[3].position, plain.position, atol=1e-6 * moved)
    assert [frame.iterations > 0 for frame in frames[3:]] == [True] * 5 + [False] * 2, (
        "the last value is held"
    )


def test_its_times_are_events_for_adaptive_steps_and_statics(tmp_path: Path):
    model, _ = play(pulled(tmp_path, steps=1))
    environment = Environment(model)
    assert set(TABLE["times"]) <= set(environment.events())
    assert environment.is_same(0, STEP) and environment.is_same(8 * STEP, 9 * STEP)
    assert not environment.is_same(3 * STEP, 4 * STEP)


def test_a_step_reads_only_the_rows_near_it(monkeypatch):
    """A table of 100,000 rows, ten of them in the step."""
    times = np.linspace(0, 100, 100_001)
    table, read = Lines(times, np.column_stack([times] * 3)), []

    def interp(at: float, x: np.ndarray, y: np.ndarray) -> float:
        read.append(len(x))
        return interpolate(at, x, y)

    interpolate = np.interp
    monkeypatch.setattr(np, "interp", interp)
    assert table.mean(50, 50.01, 0.0, None) == pytest.approx([50.005] * 3, rel=1e-12)
    assert max(read) == 2 and len(read) < 3 * 30


WRONG = {
    "must have ascending times": {"times": [0, 0], "values": [[0, 0, 0], [0, 0, 1]]},
    "2 times and 1 values": {"times": [0, 1], "values": [[0, 0, 0]]},
    "force.0.total.values.0.2: required": {"times": [0], "values": [[0, 0]]},
    "force.0.total.times.0: must be greater than or": {"times": [-1], "values": [[0, 0, 1]]},
    "force.0.total.time: unknown key, did you mean 'times'?": {"time": [0], "values": [[0, 0, 1]]},
    "force.0.total.2: required": [1, 2],
    "force.0.total: must be a list": "down",
}


@pytest.mark.parametrize("words", WRONG)
def test_a_mistake_in_it_is_one_line(words: str, tmp_path: Path):
    assert words in input_error(lambda: load_scene(pulled(tmp_path, WRONG[words])))


def test_a_table_of_nothing_on_held_nodes_is_no_mistake_and_one_of_something_is(tmp_path: Path):
    held = {"pin": [{"region": FOOT}]}
    force = {"region": FOOT, "total": {"times": [0, 1], "values": [[0, 0, 0], [0, 0, 0]]}}
    path = block_scene(tmp_path, time={"step": STEP, "duration": STEP}, force=[force], **held)
    play(path)
    with pytest.raises(InputError, match="moves nothing"):
        play(path, "force.0.total.values=[[0, 0, 0], [1, 0, 0]]")
