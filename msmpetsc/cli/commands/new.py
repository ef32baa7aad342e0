"""``msmpetsc new``: write a first scene for a mesh, or copy a scene that comes with msmpetsc.

The command measures the mesh, guesses its unit and upward axis, and counts its faults and parts.
A long horizontal body is clamped at an end and bends under its weight; any other body falls on
the ground. Young's modulus is chosen so that the body deforms visibly. The time step is a
fraction of the period of its slowest motion.
"""

import argparse
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote

import igl
import numpy as np
from scipy.spatial import ConvexHull, QhullError

import msmpetsc
from msmpetsc.app.checks import SCENE_NAMES, refuse_other_format
from msmpetsc.backend.arrays import Floats
from msmpetsc.build import USUAL_SIDES
from msmpetsc.comm import log
from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.geometry.prepare import part_labels
from msmpetsc.geometry.registry import MODELS, load, locate
from msmpetsc.geometry.surface import Surface, SurfaceReport, check_encloses, examine
from msmpetsc.geometry.thickness import Thickness, thickness_of, thickness_words
from msmpetsc.lattice.material import STEPS_A_PERIOD, bending_period
from msmpetsc.results.disk import write_whole
from msmpetsc.scene.body import SOLID
from msmpetsc.scene.key_table import SCHEMA_FILE, json_schema
from msmpetsc.scene.reading import lies_below, scene_of
from msmpetsc.scene.toml import toml_of

# folder of the shipped scenes, which a wheel also has; in a clone a link to scenes/
SHIPPED = Path(msmpetsc.__file__).parent / "shipped"
MILLIMETRE = 1e-3
# formats whose definition has y upwards
Y_UP_FORMATS = (".glb", ".gltf")
# distance above the lowest point within which a point stands on the ground [height]
SOLE = 0.02
# loss of stability of a flat base [-]; a table stands on its feet, not on its top
FLAT_PENALTY = 0.5
# excess of y's uprightness over z's to take y as upwards [-]; z is the usual axis
SURER = 0.1
# gravity [m/s^2]
G = 9.81
# density of the body [kg/m^3]; water
DENSITY = 1000.0
# longest side if the unit of the file cannot be guessed [m]; a typical model
DEFAULT_SIZE = 0.3
# length of a beam [its other sides]
SLENDER = 2.5
# height above the ground of a falling body [its height]
DROP = 0.2
# least and largest number of cells [-]; so that a run takes a minute or so
CELLS = (1000, 8000)
# Young's modulus of a falling body [rho g H]; its own weight compresses it by 1%
STIFFNESS = 100
# deflection of a beam's end under its weight [length]
SAG = 0.15
# clamped part of a beam [length]
CLAMPED = 0.05
# duration after any fall [periods of the slowest motion]
PERIODS = 3
# largest total area of loose parts to drop [total area]
DEBRIS = 0.01
# column of comments
COLUMN = 39
# preparation step that turns y upwards into z upwards
TURN = "{ rotate = { axis = [1, 0, 0], degrees = 90 } }"
GRAVITY = """[gravity]
acceleration = [0, 0, -9.81] # [m/s^2]"""


def run(args: argparse.Namespace) -> int:
    """Write the scene, or list the shipped scenes; return the exit status."""
    if args.list:
        titles = shipped_titles()
        print(
            "\n".join(f"{name:{max(map(len, titles))}}  {title}" for name, title in titles.items())
        )
        return 0
    if args.scene is None or (args.mesh is None) == (args.from_scene is None):
        raise InputError(
            "new takes the scene's name and --mesh MESH or --from NAME: "
            "msmpetsc new my.toml --mesh my.ply"
        )
    refuse_other_format("new", args.scene, SCENE_NAMES)
    if args.scene.exists() and not args.overwrite:
        raise InputError(f"{args.scene} exists already: --overwrite replaces it")
    if args.from_scene is not None:
        text = f"#:schema {SCHEMA_FILE}\n{shipped_text(args.from_scene)}"
    else:
        text = drafted(args.mesh, args.scene, args.up)
    # raise before writing a scene that run would refuse
    scene_of(args.scene, text, to_read=False)
    write_whole(args.scene.with_name(SCHEMA_FILE), json.dumps(json_schema(), indent=1) + "\n")
    write_whole(args.scene, text)
    print(f"{args.scene}\nto run it: msmpetsc run {quote(str(args.scene))} --picture")
    return 0


def drafted(mesh: Path, scene: Path, up: str | None) -> str:
    """Return the text of a scene for a mesh file or a registry name. Raises InputError.

    up : the mesh's upward axis, "y" or "z"; None for a guess: y for glTF, or if the body stands
        better with y upwards than with z upwards
    """
    source = str(mesh) if str(mesh) in MODELS else path_from(scene, mesh)
    surface = load(source, scene.parent)
    report = examine(surface)
    warnings = check_encloses(surface, report)
    if up is None:
        is_y = (
            mesh.suffix.lower() in Y_UP_FORMATS
            or uprightness(surface, 1) > uprightness(surface, 2) + SURER
        )
        up = "y" if is_y else "z"
    measures = measured(surface, report, up)
    log.info("%s: %s", mesh, measures.words)
    for warning in warnings:
        log.warning("%s: %s", mesh, warning)
    log.info(
        "%s, its longest side as %.4g m: mesh.size in the scene sets it",
        measures.unit_words,
        measures.sides.max(),
    )
    log.info("%s is taken for upwards: --up says another axis", up)
    return draft(source, scene.stem, measures)


def path_from(scene: Path, mesh: Path) -> str:
    """Return the path of a mesh relative to its scene. Raises InputError for a mesh elsewhere."""
    folder = scene.parent
    if not mesh.exists():
        # raises the error of a missing mesh
        locate(str(mesh), Path())
    if not lies_below(folder, str(mesh.resolve())):
        raise InputError(
            f"{mesh} is not in {folder.resolve()}, nor below it, as a scene requires: "
            "write the scene beside its mesh"
        )
    return str(mesh.resolve().relative_to(folder.resolve()))


def shipped_titles() -> dict[str, str]:
    """Return the titles of the shipped scenes. Raises InputError if there are none."""
    files = sorted(SHIPPED.glob("*.toml"))
    if not files:
        raise InputError(f"{SHIPPED} has no scenes: this msmpetsc was installed without them")
    return {path.stem: toml_of(path.read_text(encoding="utf-8")).get("title", "") for path in files}


def shipped_text(name: str) -> str:
    """Return the text of a shipped scene. Raises InputError for an unknown name."""
    titles = shipped_titles()
    if name not in titles:
        raise InputError(
            f"no scene {name!r} comes with msmpetsc{did_you_mean(name, titles)}: "
            "msmpetsc new --list"
        )
    return (SHIPPED / f"{name}.toml").read_text(encoding="utf-8")


# ---- the mesh


@dataclass(frozen=True)
class MeshMeasures:
    """Measures of a mesh for its first scene, with z upwards.

    up        : upward axis of the file
    unit      : unit of the file [m]; None if neither metres nor millimetres give a usual size
    sides     : of the bounding box (3,) [m]
    thickness : [m]; None if the mesh is open
    volume    : enclosed volume [m^3]
    report    : in the unit of the file
    parts     : fraction of the area (p,) of each connected part, the largest first
    """

    up: str
    unit: float | None
    sides: Floats
    thickness: Thickness | None
    volume: float
    triangles: int
    report: SurfaceReport
    parts: Floats

    @property
    def beam_axis(self) -> int | None:
        """Return the horizontal axis of a beam; None for a body that is no horizontal beam."""
        longest = int(np.argmax(self.sides))
        is_slender = self.sides[longest] >= SLENDER * np.delete(self.sides, longest).max()
        return longest if longest < 2 and is_slender else None

    @property
    def unit_words(self) -> str:
        """Return a phrase on the unit of the file."""
        if self.unit is None:
            return "the unit of the file is unknown"
        return f"the file is taken to be in {'mm' if self.unit == MILLIMETRE else 'm'}"

    @property
    def words(self) -> str:
        """Return a phrase on triangles, boundary and parts."""
        boundary = "closed"
        parts = "1 part"
        if not self.report.closed:
            boundary = f"open ({self.report.boundary_edges} boundary edges)"
        if len(self.parts) > 1:
            parts = f"{len(self.parts)} parts, the largest of {self.parts[0]:.0%} of the area"
        return f"{self.triangles} triangles, {boundary}, {parts}"


def measured(surface: Surface, report: SurfaceReport, up: str) -> MeshMeasures:
    """Return the measures of a file's surface, whose axis ``up`` points upwards."""
    sides = np.ptp(surface.points[np.unique(surface.triangles)], axis=0)
    unit = unit_of(float(sides.max()))
    metres = unit or DEFAULT_SIZE / sides.max()
    areas = np.bincount(part_labels(surface), igl.doublearea(surface.points, surface.triangles))
    return MeshMeasures(
        up=up,
        unit=unit,
        sides=metres * (sides[[0, 2, 1]] if up == "y" else sides),
        thickness=thickness_of(replace(surface, points=metres * surface.points), report),
        volume=metres**3 * abs(report.volume),
        triangles=len(surface.triangles),
        report=report,
        parts=np.sort(areas / areas.sum())[::-1],
    )


def unit_of(side: float) -> float | None:
    """Return the unit [m] in which a longest side has a usual size: metres, millimetres or None."""
    low, high = USUAL_SIDES
    return next((unit for unit in (1.0, MILLIMETRE) if low <= side * unit <= high), None)


def uprightness(surface: Surface, axis: int) -> float:
    """Return the excess in [-1, 1] of a body's stability with an axis upwards over downwards.

    A chair is stable on its feet and unstable on its head, but on its side about equally stable
    both ways.
    """
    return stability(surface, axis, 1) - stability(surface, axis, -1)


def stability(surface: Surface, axis: int, sign: int) -> float:
    """Return the stability in [0, 1] of a body with an axis upwards (sign 1) or downwards (-1).

    The base is the convex hull of the lowest points in the ground plan. The stability is the area
    of the base over the area of the hull of all points. A base that is a flat face instead of
    feet lowers it. If the centre of the surface is not above the base, it is zero.
    """
    used = np.unique(surface.triangles)
    plan = np.delete(surface.points, axis, axis=1)
    height = sign * surface.points[:, axis]
    height -= height[used].min()
    is_low = height <= SOLE * height[used].max()
    # qhull fails for a base that is an edge or a corner
    try:
        base = ConvexHull(plan[used[is_low[used]]])
        whole = ConvexHull(plan[used])
    except QhullError:
        return 0.0
    areas = igl.doublearea(surface.points, surface.triangles)
    centre = areas @ plan[surface.triangles].mean(axis=1) / areas.sum()
    if not (base.equations[:, :2] @ centre + base.equations[:, 2] <= 0).all():
        return 0.0
    lowest = surface.triangles[is_low[surface.triangles].all(axis=1)]
    flat = np.insert(plan, 2, 0.0, axis=1)
    # the volume of a hull in two dimensions is an area
    flatness = igl.doublearea(flat, lowest).sum() / 2 / base.volume
    return float(base.volume / whole.volume * (1 - FLAT_PENALTY * min(flatness, 1.0)))


# ---- the scene


def draft(source: str, title: str, mesh: MeshMeasures) -> str:
    """Return the text of a scene for a mesh that the scene names ``source``."""
    head = f"""#:schema {SCHEMA_FILE}
# A first draft by msmpetsc new: adjust every value. All keys: msmpetsc keys
title = {json.dumps(title, ensure_ascii=False)}

"""
    moved = _falling(mesh) if mesh.beam_axis is None else _clamped(mesh, mesh.beam_axis)
    tables = "\n\n".join([_mesh(source, mesh), _cages(mesh), moved])
    return head + "".join(f"{_aligned(line)}\n" for line in tables.split("\n"))


def _mesh(source: str, mesh: MeshMeasures) -> str:
    """Return the table of the mesh, with comments on its defects."""
    report = mesh.report
    lines = [
        "[mesh]",
        f"source = {json.dumps(source, ensure_ascii=False)} # {mesh.words}",
        f"# {mesh.up} is taken for upwards: msmpetsc new --up sets another axis",
    ]
    # reason of each preparation step
    steps = {}
    if len(mesh.parts) > 1 and mesh.parts[1:].sum() < DEBRIS:
        steps['"largest_part"'] = (
            f"the other parts have {100 * mesh.parts[1:].sum():.1g}% of the area"
        )
    if report.inconsistent_edges or report.volume < 0:
        steps['"orient"'] = "faces are wound inwards, or against each other"
    if mesh.up == "y":
        steps[TURN] = "scenes have z upwards"
    if steps:
        lines += [f"# {reason}" for reason in steps.values()]
        lines.append(f"prepare = [{', '.join(steps)}]")
    if not report.closed:
        lines.append(
            "# open: the winding number decides which cells are inside; "
            'prepare = ["repair"] closes the mesh'
        )
    if len(mesh.parts) > 1 and '"largest_part"' not in steps:
        lines.append(
            "# parts that share no cell move separately; "
            'prepare = ["union"] joins parts that overlap'
        )
    lines.append(f"size = {plain(mesh.sides.max(), 5)} # longest side [m]; {mesh.unit_words}")
    if mesh.beam_axis is None:
        centre = "centre of the bottom face [m]: the body falls a fifth of its height"
        lines.append(f"base = [0, 0, {plain(DROP * mesh.sides[2], 2)}] # {centre}")
    return "\n".join(lines)


def _cages(body: MeshMeasures) -> str:
    """Return the table of cages."""
    # by volume alone, as for a body of many cells
    size = body.thickness.advised_size(SOLID) if body.thickness else np.inf
    count = int(float(plain(min(max(body.volume / size**3, CELLS[0]), CELLS[1]), 1)))
    words = "cells"
    if body.thickness:
        cell_size = (body.volume / count) ** (1 / 3)
        words += f"; the body is {thickness_words(body.thickness.cells(cell_size))}"
    return f"[cages]\ncount = {count} # {words}"


def _falling(body: MeshMeasures) -> str:
    """Return the tables of a body that falls on the ground."""
    height = float(body.sides[2])
    young = STIFFNESS * DENSITY * G * height
    # of a standing quarter wave along the height, with the speed sqrt(E / rho)
    period = 4 * height / math.sqrt(young / DENSITY)
    fall = math.sqrt(2 * DROP * height / G)
    return f"""{_material(young, f"its own weight compresses it by about {100 / STIFFNESS:g}%")}

{_time(2 * fall + PERIODS * period, period)}

{GRAVITY}

[[obstacle]]
shape = "plane" # the ground; the body is no horizontal beam, so it falls
point = [0, 0, 0] # [m]
normal = [0, 0, 1] # towards the free side
response = "penalty" # or "reflect", with a restitution
friction = 0.5 # Coulomb's coefficient"""


def _clamped(body: MeshMeasures, axis: int) -> str:
    """Return the tables of a body that is clamped at an end.

    The body counts as an Euler-Bernoulli beam of full rectangular section.
    """
    length = float(body.sides[axis])
    thickness = float(body.sides[2])
    # deflection of the end under the weight: q l^4 / 8 E I = SAG l
    young = 1.5 * DENSITY * G * length**3 / (thickness**2 * SAG)
    period = bending_period(length, thickness, young, DENSITY)
    direction = np.eye(3, dtype=int)[axis]
    point = ", ".join(f"{CLAMPED * component:g}" for component in direction)
    normal = ", ".join(str(-component) for component in direction)
    return f"""{_material(young, f"its end sinks by about {100 * SAG:g}% of its length")}

{_time(PERIODS * period, period)}

{GRAVITY}

[[pin]] # the body is a horizontal beam: an end is clamped
region = {{ half_space = {{ point = [{point}], normal = [{normal}] }}, relative = true }}"""


def _material(young: float, effect: str) -> str:
    """Return the table of the material."""
    return f"""[material]
young_modulus = {plain(young, 1)} # [Pa]; {effect}
density = {plain(DENSITY, 4)} # [kg/m^3], as water
law = "neo-hookean" # a solid; "linear": the paper's springs
poisson_ratio = 0.25 # [-]; tissue has 0.45, rubber 0.49"""


def _time(duration: float, period: float) -> str:
    """Return the table of time for a duration [s] and a slowest period [s]."""
    step = float(plain(period / STEPS_A_PERIOD, 1))
    return f"""[time]
step = {step:g} # [s]; the slowest motion has a period of about {period:.2g} s
duration = {step * math.ceil(duration / step):.6g} # [s]"""


def _aligned(line: str) -> str:
    """Return a line of TOML with its comment, if it has one, at a fixed column."""
    setting, mark, comment = line.rpartition(" # ")
    return f"{setting:{COLUMN - 1}}{mark}{comment}" if mark else line


def plain(value: float, digits: int) -> str:
    """Return a number with a number of digits in short TOML notation, for example 3e5."""
    return f"{value:.{digits}g}".replace("e+0", "e")
