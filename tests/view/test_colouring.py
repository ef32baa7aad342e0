"""Fields on a surface: each on a motion of which it is known."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ball_result import BARE, HEIGHTS
from surface_alone import drawable_of

from msmpetsc.errors import InputError
from msmpetsc.results.reader import Result
from msmpetsc.scene.schema import SceneFile
from msmpetsc.scene.toml import toml_of
from msmpetsc.view.colours import COLOURINGS, SCALE, Colouring, colouring_of, scaled
from msmpetsc.view.drawable import BodiesAtRest, Drawable, drawable_of_result


@pytest.fixture(scope="module")
def subject(falling_ball: Path) -> Iterator[Drawable]:
    with Result(falling_ball) as run:
        yield drawable_of_result(run)


def test_displacement_of_a_fall_is_its_height(subject):
    values = colouring_of(subject, "displacement").values
    for index in (0, 2, 3, 8):
        assert values(index) == pytest.approx(np.full(len(subject.rest.points), HEIGHTS[0] - HEIGHTS[index]), abs=1e-6)


def test_speed_is_the_way_over_the_time_around_a_frame(subject):
    values = colouring_of(subject, "speed").values
    assert values(0) == pytest.approx(np.full(len(subject.rest.points), 0.05 / 0.1), rel=1e-4)  # towards frame 1
    assert values(2) == pytest.approx(np.full(len(subject.rest.points), 0.35 / 0.2), rel=1e-4)  # 0.45 to 0.1 m
    assert values(8) == pytest.approx(0.0, abs=1e-5)  # 0.2 m before and after


def test_stress_is_von_mises_at_the_nodes_in_a_unit_of_its_size(subject):
    nodes = len(subject.rest.nodes)
    stressed = replace(subject, von_mises=lambda index: np.full(nodes, 2e6 * index))
    shown = scaled(colouring_of(stressed, "stress"), [0, 1])
    assert shown.values(1) == pytest.approx(np.full(len(subject.rest.points), 2e6))
    assert shown.ends == ("0", "von Mises' stress [MPa]", "2")
    with pytest.raises(InputError, match="is of springs"):
        colouring_of(subject, "stress")
    text = BARE.replace("stiffness = 1.0", 'young_modulus = 1.0, law = "neo-hookean"')
    solid = SceneFile.model_validate(toml_of(text))
    with pytest.raises(InputError, match=r"output\.stress = true"):
        colouring_of(replace(subject, scene=solid), "stress")


def test_strain_is_the_root_mean_square_of_the_springs_at_a_node():
    """Three nodes in a row: the first spring 10% longer, the second 20% shorter."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    moved = np.array([[0.0, 0, 0], [1.1, 0, 0], [1.9, 0, 0]])
    subject = replace(
        drawable_of(points, np.array([[0, 1, 2]])),
        nodes=lambda _: moved,
        array={"lattice/springs": np.array([[0, 1], [1, 2]]), "lattice/rest_length": np.ones(2)}.__getitem__,
    )
    values = COLOURINGS["strain"](subject).values(0)
    assert values == pytest.approx([0.1, np.sqrt((0.1**2 + 0.2**2) / 2), 0.2])


def test_parts_are_those_of_the_nearest_cell(subject):
    """Two cells; the later of two parts that both mean the second one counts."""
    x, y, z = np.mgrid[0:3, 0:2, 0:2].reshape(3, -1)
    cells = np.array([np.flatnonzero((x == i) | (x == i + 1)) for i in range(2)])
    nodes, points = np.stack([x, y, z], axis=1).astype(float), np.array([[0.2, 0.5, 0.5], [1.9, 0.1, 0.1]])
    rest = BodiesAtRest(nodes, cells, points, np.zeros(len(nodes), int), np.zeros(2, int))
    east = "region = { half_space = { point = [1, 0, 0], normal = [1, 0, 0] } }\n"
    tables = f"[[part]]\n{east}density = 2.0\n[[part]]\n{east}density = 3.0\n"
    parted = replace(subject, rest=rest, scene=SceneFile.model_validate(toml_of(BARE + tables)))
    part = colouring_of(parted, "part")
    assert part.values(0).tolist() == [0, 2] and part.classes == ("material", "part.0", "part.1")


@pytest.mark.parametrize(
    ("high", "end"), [(0.0125, ("0", "way [mm]", "12.5")), (3.0, ("0", "way [m]", "3")), (0.0, ("0", "way [m]", "0"))]
)
def test_ends_of_the_scale_have_a_fitting_unit(high, end):
    assert Colouring("way", "m", lambda _: np.zeros(1), high).ends == end


def test_the_scale_ends_where_its_colours_do():
    colouring = Colouring("way", "m", lambda _: np.array([-1.0, 0, 2, 7]), 2.0)
    shown = [f"#{bytes(colour).hex()}" for colour in colouring.table[colouring.numbers(0)]]
    assert shown == [SCALE[k] for k in (0, 0, -1, -1)]
