"""Scenes of all kinds agree on two ranks and in a serial run.

The lattice is the same. Frames agree to the error of their steps.
"""

from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from block_scene import (
    CELL,
    CLAMP,
    EPS,
    GRAVITY,
    SIDES,
    block_scene,
    box_at,
    half_space,
    plane_at,
    roller,
)
from one_process import answers_on

BEAM = np.array([1.0, 0.25, 0.25])
LEFT = {"box": [[-1, -1, -1], [0.01, 1, 1]]}
RIGHT = {"box": [[0.99, -1, -1], [2, 1, 1]]}
FAR = {"half_space": {"point": [0.25, 0, 0], "normal": [1, 0, 0]}}
TILTED = {"half_space": {"point": [0.1, 0, 0], "normal": [-1, 0.3, 0.2]}}
FLOOR = plane_at(-0.01, response="penalty", friction=0.4) | {"normal": [0, 0.1, 1]}
WALL = plane_at(path=[{"time": 0.1, "by": [-0.06, 0, 0]}])
WALL |= {"point": [0.55, 0, 0], "normal": [-1, 0, 0]}
PLATE = box_at([[-1, -1, 0.25], [2, 2, 0.6]], response="penalty")
PLATE |= {"path": [{"time": 0.1, "by": [0, 0, -0.15]}]}
SOFT = {"young_modulus": 1e5, "density": 1000.0}
SOLID = SOFT | {"law": "neo-hookean", "poisson_ratio": 0.3}
LED = [{"region": LEFT, "path": [{"time": 0.1, "by": [0, 0, 0.05]}], "stop": 0.12}]
TURNED = [{"region": RIGHT, "path": [{"time": 1.0, "turn": [30, 0, 0]}]}]
LIFTED = [
    {"region": half_space(0, 0.5 - EPS, 1), "fix": ["z"], "stop": 0.03,
     "path": [{"time": 0.02, "by": [9, 9, 0.02]}]},
]  # fmt: skip
ALL = {"box": [[0, 0, 0], [1, 1, 1]], "relative": True}
SWITCHED = [
    {"region": RIGHT, "total": [0, 0, sign], "start": start}
    for sign, start in ((0.2, 0.0), (-0.4, 3.0))
]


class Case(NamedTuple):
    """Tables of a scene, words of the command, tolerance of positions [sides], equal numbers."""

    tables: dict[str, Any]
    words: tuple[str, ...] = ()
    accuracy: float = 1e-7
    equal: tuple[str, ...] = ()


def steps(
    count: int, step: float, integrator: str = "implicit-euler", **more: Any
) -> dict[str, Any]:
    return {"step": step, "duration": count * step, "integrator": integrator} | more


def led(preset: str) -> Case:
    """Anchor nearly all nodes: only six in the last corner are free at first, so one rank has none.

    The solver is built three times.
    """
    path = [{"time": 0.05, "by": [0, 0, 0.02]}, {"time": 0.1, "by": [0, 0.01, 0.03]}]
    boxes = {0.025: [[0, 0, 0], [0.5, 0.3, 0.25]], 0.045: [[0, 0.3, 0], [0.4, 0.5, 0.25]]}
    anchors = [{"region": {"box": box}, "path": path, "stop": stop} for stop, box in boxes.items()]
    tables = {"anchor": anchors, "gravity": GRAVITY, "time": steps(6, 0.01)}
    tables["solver"] = {"preset": preset, "error": 1e-10}
    # fast-msm solves directly
    return Case(tables, () if preset == "fast-msm" else ("-ksp_rtol", "1e-8"), 1e-8)


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
        "pin": [{"region": LEFT}, {"region": {"painted": [3]}}],
        "gravity": GRAVITY, "time": steps(3, 1 / 64),
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
    "rollers": Case({
        "sides": SIDES * [1, 0.5, 1], "pin": [CLAMP, roller(1, 0.25 - EPS, 1)], "anchor": LIFTED,
        "material": SOLID, "gravity": {"acceleration": [0.5, 0, -9.81]},
        "solver": {"preset": "newton-multigrid", "error": 1e-10}, "time": steps(5, 0.01, "bdf2"),
    }, accuracy=1e-9),
    "surface loads": Case({
        "material": SOLID, "pin": [roller(0)], "time": steps(22, 0.01, "bdf2"),
        "pressure": [{"region": ALL, "start": 0.02,
                      "value": {"times": [0, 0.2], "values": [1e3, 5e3]}}],
        "traction": [{"region": half_space(0, 0.49, 1), "value": [0, 0, 50], "stop": 0.1}],
    }),
    # a plate pushes from below, a second plate reflects nodes of some ranks sideways
    "thin plates": Case({
        "sides": BEAM, "material": SOFT | {"young_modulus": 1e6}, "time": steps(23, 0.002, "bdf2"),
        "obstacle": [
            box_at([[-9, -9, -0.02], [9, 9, -0.019]], response="penalty", friction=0.3,
                   path=[{"time": 1.0, "by": [0, 0, 3.0]}]),
            box_at([[-0.012, -9, -9], [-0.011, 9, 9]], path=[{"time": 1.0, "by": [3.0, 0, 0]}]),
        ],
    }),
    # the seventh step has two minima, of 5 and 7 contacts; ranks find either of them
    "barrier": Case({
        "mesh": {"source": "barrier.ply", "prepare": [{"refine": 0.1}]},
        "material": SOLID | {"damping": 5.0}, "self_contact": {"friction": 0.5},
        "obstacle": [{"shape": "sphere", "center": [0.23, 0.28, 0.36], "radius": 0.1,
                      "response": "barrier", "path": [{"time": 0.5, "by": [0, 0, -0.06]}]}],
        "pin": [{"region": {"box": [[-1, -1, -1], [1, 1, 0.01]]}}], "solver": {"error": 1e-8},
        "time": steps(6, 0.05),
    }, accuracy=1e-6),
    # obstacles move the body by more than the barrier's distance; the second step has
    # several minima, and a change of 1e-6 in Young's modulus finds another
    "squeezed": Case({
        "mesh": {"source": "squeezed.ply", "prepare": [{"refine": 0.1}]}, "material": SOLID,
        "obstacle": [
            box_at([[-0.3, -0.3, -0.1], [0.8, 0.8, -0.004]], response="barrier"),
            box_at([[-0.3, -0.3, 0.252], [0.8, 0.8, 0.35]], response="barrier",
                   center=[0.25, 0.25, 0.252],
                   path=[{"time": 0.02, "by": [0, 0, -0.1], "turn": [6, 0, 0]}]),
        ],
        "solver": {"error": 1e-8}, "time": steps(1, 0.01),
    }, accuracy=1e-6),
    **{f"led, {preset}": led(preset) for preset in ("newton", "anderson", "fast-msm")},
}  # fmt: skip
# numbers of frames that are compared if they are stored
FIELDS = {"kinetic", "elastic", "contact", "torque", "reaction", "push", "load", "surface_load"}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[h5py.File]]:
    """Return the results of each scene on one rank and on two, all from one process a rank."""
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
    energy = max(np.abs(expected[field]).max() for field in ("kinetic", "elastic"))
    for field in (FIELDS | {"energy_gained"}) & set(expected):
        most = energy if field == "energy_gained" else np.abs(expected[field]).max()
        atol = 10 * CASES[name].accuracy * most
        np.testing.assert_allclose(frames[field], expected[field], rtol=0, atol=atol)
    if "embedding" in one:
        np.testing.assert_allclose(two["embedding/weights"], one["embedding/weights"], rtol=1e-13)
        np.testing.assert_allclose(frames["surface"], expected["surface"], rtol=0, atol=1e-6 * size)
    if name != "clamp":
        assert np.abs(expected["position"][-1] - one["lattice/nodes"]).max() > 1e-4 * size
