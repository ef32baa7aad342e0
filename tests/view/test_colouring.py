"""Fields on a surface, each for a motion whose field is known."""

import tomllib
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
from msmpetsc.view.colours import COLOURINGS, SCALE, Colouring, colouring_of, scaled
from msmpetsc.view.drawable import BodiesAtRest, Drawable, drawable_of_result


@pytest.fixture(scope="module")
def subject(falling_ball: Path) -> Iterator[Drawable]:
    with Result(falling_ball) as run:
        yield drawable_of_result(run)


def test_displacement_of_a_fall_is_its_height(subject):
    values = colouring_of(subject, "displacement").values
    for index in (0, 2, 3, 8):
        assert values(index) == pytest.approx(HEIGHTS[0] - HEIGHTS[index], abs=1e-6)


def test_speed_is_the_way_over_the_time_around_a_frame(subject):
    values = colouring_of(subject, "speed").values
    # motion towards frame 1
    assert values(0) == pytest.approx(0.05 / 0.1, rel=1e-4)
    # from 0.45 to 0.1 m
    assert values(2) == pytest.approx(0.35 / 0.2, rel=1e-4)
    # 0.2 m before and after the frame
    assert values(8) == pytest.approx(0.0, abs=1e-5)


def solid_scene(young: float) -> SceneFile:
    """Return the scene of the ball as a solid."""
    law = f'young_modulus = {young}, law = "neo-hookean"'
    text = BARE.replace('stiffness = 1.0, law = "linear"', law)
    return SceneFile.model_validate(tomllib.loads(text))


def test_stress_is_von_mises_at_the_nodes_in_a_unit_of_its_size(subject):
    nodes = len(subject.rest.nodes)
    stressed = replace(subject, von_mises=lambda index: np.full(nodes, 2e6 * index))
    shown = scaled(colouring_of(stressed, "stress"), subject, [0, 1])
    assert shown.values(1) == pytest.approx(np.full(len(subject.rest.points), 2e6))
    assert shown.label == "von Mises' stress [MPa]" and shown.high == 2e6
    assert shown.ticks == ((0, "0"), (0.25, "0.5"), (0.5, "1"), (0.75, "1.5"), (1, "2"))
    with pytest.raises(InputError, match="is of springs"):
        colouring_of(subject, "stress")
    solid = solid_scene(young=1.0)
    with pytest.raises(InputError, match=r"output\.stress = true"):
        colouring_of(replace(subject, scene=solid), "stress")


def test_strain_is_the_root_mean_square_of_the_springs_at_a_node():
    """The first of two springs between three nodes is 10% longer, the second 20% shorter."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    moved = np.array([[0.0, 0, 0], [1.1, 0, 0], [1.9, 0, 0]])
    springs = {"lattice/springs": np.array([[0, 1], [1, 2]]), "lattice/rest_length": np.ones(2)}
    triangle = drawable_of(points, np.array([[0, 1, 2]]))
    subject = replace(triangle, nodes=lambda _: moved, array=springs.__getitem__)
    values = COLOURINGS["strain"](subject).values(0)
    assert values == pytest.approx([0.1, np.sqrt((0.1**2 + 0.2**2) / 2), 0.2])


def test_parts_are_those_of_the_nearest_cell(subject):
    """If two parts contain the second cell, the later part counts."""
    x, y, z = np.mgrid[0:3, 0:2, 0:2].reshape(3, -1)
    cells = np.array([np.flatnonzero((x == i) | (x == i + 1)) for i in range(2)])
    nodes = np.stack([x, y, z], axis=1).astype(float)
    points = np.array([[0.2, 0.5, 0.5], [1.9, 0.1, 0.1]])
    rest = BodiesAtRest(nodes, cells, points, np.zeros(len(nodes), int), np.zeros(2, int))
    east = "region = { half_space = { point = [1, 0, 0], normal = [1, 0, 0] } }\n"
    tables = f"[[part]]\n{east}density = 2.0\n[[part]]\n{east}density = 3.0\n"
    scene = SceneFile.model_validate(tomllib.loads(BARE + tables))
    part = colouring_of(replace(subject, rest=rest, scene=scene), "part")
    assert part.values(0).tolist() == [0, 2] and part.classes == ("material", "part.0", "part.1")


@pytest.mark.parametrize(
    ("high", "unit", "label", "ticks"),
    [
        (0.0125, "m", "way [mm]", ["0", "5", "10"]),
        (3.0, "m", "way [m]", ["0", "1", "2", "3"]),
        (0.0, "m", "way [m]", ["0"]),
        (0.4, "%", "way [%]", ["0", "10", "20", "30", "40"]),
    ],
)
def test_the_scale_has_ticks_at_round_numbers_of_a_fitting_unit(high, unit, label, ticks):
    shown = Colouring("way", unit, lambda _: np.zeros(1), high)
    assert shown.label == label and [number for _, number in shown.ticks] == ticks
    size = {"[mm]": 1e-3, "[m]": 1.0, "[%]": 0.01}[label.split()[1]]
    assert [share * high for share, _ in shown.ticks] == pytest.approx(
        [size * float(number) for number in ticks]
    )


def test_few_points_at_a_clamp_do_not_rule_the_scale_and_it_says_so():
    """The scale ignores 5 MPa at two points of a clamp, where all else is below 100 kPa.

    The surface is a grid of 51 x 51 points.
    """
    x, y = np.mgrid[0:51, 0:51].reshape(2, -1)
    first = np.flatnonzero((x < 50) & (y < 50))
    triangles = np.concatenate([first[:, None] + [0, 51, 52], first[:, None] + [0, 52, 1]])
    subject = drawable_of(np.stack([x, y, 0 * x], axis=1) / 50.0, triangles)
    stress = 1e5 * x / 50.0
    smooth = scaled(Colouring("stress", "Pa", lambda _: stress), subject, [0])
    # nothing is clipped that is not far above all else
    assert smooth.high == 1e5 and smooth.label == "stress [kPa]"
    peaked = np.where((x == 50) & (y < 2), 5e6, stress)
    clipped = scaled(Colouring("stress", "Pa", lambda _: peaked), subject, [0])
    said = f"stress [kPa], clipped at {clipped.high / 1e3:.3g}, most 5000"
    assert 1e5 < clipped.high < 1.3e5 and clipped.label == said
    numbers = clipped.numbers(0)
    # two of 255 if they ruled it
    assert numbers[peaked == 5e6].tolist() == [255, 255] and numbers[x == 25].min() > 90
    alone = np.where((x == 50) & (y < 2), 5e6, 0)
    assert scaled(Colouring("stress", "Pa", lambda _: alone), subject, [0]).high == 5e6


@pytest.mark.parametrize("name", ["displacement", "speed", "stress"])
def test_a_body_at_rest_is_not_tinted_though_its_field_is_rounded(subject, name):
    """Motion and stress of 1e-16 of size, age and stiffness are not coloured."""
    noise = np.random.default_rng(0).uniform(-1e-16, 1e-16, (3, *subject.rest.nodes.shape))
    still = replace(
        subject,
        scene=solid_scene(young=1e6),
        nodes=lambda index: subject.rest.nodes + noise[index],
        times=np.arange(3) / 10,
        von_mises=lambda index: 1e6 * abs(noise[index, :, 0]),
    )
    shown = scaled(colouring_of(still, name), still, [0, 1, 2])
    red, green, blue = shown.table[shown.numbers(1)].astype(int).T
    assert (red == green).all() and (green == blue).all() and shown.ticks == ((0, "0"),)


def test_the_scale_ends_where_its_colours_do():
    colouring = Colouring("way", "m", lambda _: np.array([-1.0, 0, 2, 7]), 2.0)
    shown = [f"#{bytes(colour).hex()}" for colour in colouring.table[colouring.numbers(0)]]
    assert shown == [SCALE[k] for k in (0, 0, -1, -1)]
