"""Scenes of all kinds agree on two ranks and in a serial run.

The lattice is the same. Frames agree to the error of their steps.
"""

from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from block_scene import CELL, GRAVITY, block_scene
from one_process import answers_on

BEAM = np.array([1.0, 0.25, 0.25])
LEFT = {"box": [[-1, -1, -1], [0.01, 1, 1]]}
RIGHT = {"box": [[0.99, -1, -1], [2, 1, 1]]}
FAR = {"half_space": {"point": [0.25, 0, 0], "normal": [1, 0, 0]}}
TILTED = {"half_space": {"point": [0.1, 0, 0], "normal": [-1, 0.3, 0.2]}}
FLOOR = {
    "shape": "plane",
    "point": [0, 0, -0.01],
    "normal": [0, 0.1, 1],
    "response": "penalty",
    "friction": 0.4,
}
WALL = {
    "shape": "plane",
    "point": [0.55, 0, 0],
    "normal": [-1, 0, 0],
    "path": [{"time": 0.1, "by": [-0.06, 0, 0]}],
}
PLATE = {"shape": "box", "box": [[-1, -1, 0.25], [2, 2, 0.6]], "response": "penalty"}
PLATE |= {"path": [{"time": 0.1, "by": [0, 0, -0.15]}]}
SOFT = {"young_modulus": 1e5, "density": 1000.0}
SOLID = SOFT | {"law": "neo-hookean", "poisson_ratio": 0.3}
LED = [{"region": LEFT, "path": [{"time": 0.1, "by": [0, 0, 0.05]}], "stop": 0.12}]
TURNED = [{"region": RIGHT, "path": [{"time": 1.0, "turn": [30, 0, 0]}]}]
SWITCHED = [
    {"region": RIGHT, "total": [0, 0, sign], "start": start}
    for sign, start in ((0.2, 0.0), (-0.4, 3.0))
]


class Case(NamedTuple):
    """Tables of a scene, words of the command, how near positions are [sides], and numbers of
    frames that are equal."""

    tables: dict[str, Any]
    words: tuple[str, ...] = ()
    accuracy: float = 1e-7
    equal: tuple[str, ...] = ()


def steps(
    count: int, step: float, integrator: str = "implicit-euler", **more: Any
) -> dict[str, Any]:
    return {"step": step, "duration": count * step, "integrator": integrator} | more


def pressed(law: str) -> Case:
    """Press a block to two fifths of its height."""
    obstacles = [FLOOR | {"point": [0, 0, 0], "normal": [0, 0, 1]}, PLATE]
    tables = {"material": SOFT | {"law": law}, "obstacle": obstacles, "time": steps(12, 0.01)}
    return Case(tables | {"solver": {"error": 1e-10}})


CASES = {
    "parts": Case({
        "cages": {"cell_size": 0.11},
        "part": [{"region": FAR, "density": 777.7, "young_modulus": 3e4},
                 {"region": TILTED, "young_modulus": 2e5},
                 {"region": {"painted": [3]}, "density": 9e3}],
        "pin": [{"region": LEFT}], "gravity": GRAVITY, "time": steps(3, 1 / 64),
    }),
    "start": Case({
        "start": {"scale": [1, 1, 0.5], "scatter": 0.5, "twist": {"axis": [1, 0, 1], "degrees": 40},
                  "velocity": [0, 0, 1], "spin": [2, 0, 1],
                  "gradient": [[0, 1, 0], [0, 0, 2], [1, 0, 1]],
                  "swirl": {"axis": [0, 0, 1], "distances": [0, 1], "rates": [1, 9]}},
        "time": steps(2, 1 / 128), "output": {"surface": True},
    }),
    "clamp": Case({"cages": {"cell_size": 0.11}, "pin": [{"region": TILTED}],
    "time": steps(1, 0.01)}),
    "pressed": pressed("neo-hookean"),
    "explicit": Case({
        "obstacle": [FLOOR, WALL], "anchor": LED, "material": SOLID,
        "gravity": {"acceleration": [3, 0, -9.81]}, "time": steps(12, 1 / 60, "verlet"),
    }, equal=("iterations",)),
    "multigrid": Case({
        "sides": np.array([8, 3, 3]) * CELL, "start": {"velocity": [0.5, 0, -1.5]},
        "obstacle": [FLOOR],
        "gravity": GRAVITY, "solver": {"preset": "newton-multigrid", "error": 1e-6},
        "time": steps(6, 0.01),
    }, ("-pc_mg_levels", "3"), 1e-5),
    "rescued": Case({
        "sides": BEAM, "pin": [{"region": LEFT}], "gravity": GRAVITY,
        "safety": {"on_failure": "fallback"},
        "time": steps(3, 0.1),
    }, ("-snes_max_it", "1", "-fallback_ksp_rtol", "1e-3"), 1e-6, ("fallbacks",)),
    "by error": Case({
        "sides": BEAM, "pin": [{"region": LEFT}], "gravity": GRAVITY, "solver": {"error": 1e-4},
        "time": steps(40, 0.01, "bdf2", error=3e-2),
    }, accuracy=1e-4, equal=("steps",)),
    "a saddle": Case({
        "sides": [1, 0.2, 0.2], "cages": {"count": 80, "boundary": "whole"},
        "start": {"scale": [2, 0.05, 2]},
        "material": SOFT | {"young_modulus": 283262.4}, "gravity": GRAVITY,
        "time": steps(1, 0.00208),
    }, accuracy=1e-6),
    "static": Case({
        "sides": BEAM, "pin": [{"region": LEFT}], "force": SWITCHED,
        "time": steps(4, 1.0, "static"),
    }),
    "twisted": Case({
        "sides": BEAM, "pin": [{"region": LEFT}], "anchor": TURNED, "material": SOLID,
        "solver": {"error": 1e-12},
        "time": steps(1, 1.0, "static"),
    }),
}  # fmt: skip


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[h5py.File]]:
    """Return the results of each scene on one rank and on two, all made in a process a rank."""
    folder, found = tmp_path_factory.mktemp("ranks"), {name: [] for name in CASES}
    for ranks in (1, 2):
        files = [folder / f"{name} {ranks}.h5" for name in CASES]
        scenes = [block_scene(folder, name=name, **case.tables) for name, case in CASES.items()]
        words = [case.words for case in CASES.values()]
        commands = [
            ["run", scene, "-o", file, *more]
            for scene, file, more in zip(scenes, files, words, strict=True)
        ]
        for name, file, answers in zip(CASES, files, answers_on(ranks, commands), strict=True):
            assert [status for status, _ in answers] == [0] * ranks, answers
            found[name].append(h5py.File(file))
    return found


@pytest.mark.parametrize("name", CASES)
def test_two_ranks_are_as_one(results: dict[str, list[h5py.File]], name: str):
    one, two = results[name]
    for array in ("nodes", "cells", "pinned"):
        np.testing.assert_array_equal(two["lattice"][array], one["lattice"][array])
    np.testing.assert_allclose(two["lattice/mass"], one["lattice/mass"], rtol=1e-15)
    ends, stiffness = (
        [file["lattice"][part][:] for file in (one, two)] for part in ("springs", "stiffness")
    )
    order = [np.lexsort(np.sort(of, axis=1).T) for of in ends]
    np.testing.assert_array_equal(
        *(np.sort(of[by], axis=1) for of, by in zip(ends, order, strict=True))
    )
    np.testing.assert_allclose(
        *(of[by] for of, by in zip(stiffness, order, strict=True)), rtol=1e-12
    )
    frames, expected = two["frames"], one["frames"]
    np.testing.assert_array_equal(frames["position"][0], expected["position"][0])
    size = np.ptp(one["lattice/nodes"], axis=0).max()
    np.testing.assert_allclose(
        frames["position"], expected["position"], rtol=0, atol=CASES[name].accuracy * size
    )
    for number in CASES[name].equal:
        assert expected[number][:].any() and np.array_equal(frames[number], expected[number])
    for field in {"kinetic", "elastic", "contact", "torque"} & set(expected):
        most = np.abs(expected[field]).max()
        np.testing.assert_allclose(
            frames[field], expected[field], rtol=0, atol=10 * CASES[name].accuracy * most
        )
    if "embedding" in one:
        np.testing.assert_allclose(two["embedding/weights"], one["embedding/weights"], rtol=1e-13)
        np.testing.assert_allclose(frames["surface"], expected["surface"], rtol=0, atol=1e-6 * size)
    if name != "clamp":
        assert np.abs(expected["position"][-1] - one["lattice/nodes"]).max() > 1e-4 * size
