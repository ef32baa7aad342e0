"""``msmpetsc new``: a first scene for a mesh of one's own, or a copy of one that comes with msmpetsc.

The mesh is measured; its unit and its upward axis are guessed, its faults and parts counted. The body either falls on
the ground or, long and lying, is clamped at one end and bends under its weight. Young's modulus follows from the size,
so that any body deforms visibly; the step from the period of its slowest motion.
"""

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

import numpy as np
import trimesh
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
from msmpetsc.lattice.material import STEPS_A_PERIOD, bending_period
from msmpetsc.results.disk import write_whole
from msmpetsc.scene.key_table import SCHEMA_FILE, json_schema
from msmpetsc.scene.reading import lies_below, scene_of
from msmpetsc.scene.toml import toml_of

SHIPPED = (
    Path(msmpetsc.__file__).parent / "shipped"
)  # the scenes that a wheel holds, too; in a clone a link to scenes/
MILLIMETRE = 1e-3  # [m]
Y_BY_DEFINITION = (".glb", ".gltf")  # points upwards in such files
SOLE = 0.02  # of the height: what lies so near to the lowest point may stand on the ground
FEET = 0.5  # share of the sole that counts less where it is flat, as a table's top is: feet are likelier below
SURER = 0.1  # by so much y must stand better than z to be upwards
G, DENSITY = 9.81, 1000.0  # [m/s^2], [kg/m^3]
USUAL_SIZE = 0.3  # [m], where the file's unit cannot be guessed
SLENDER = 2.5  # times its other sides: so long a body is a beam
DROP = 0.2  # of the height, that a body falls
ACROSS, CELLS = 3, (1000, 8000)  # cells across the mean thickness, within these counts
SINKING = 100  # rho g H in Young's modulus, of a body that falls
SAG, CLAMPED = 0.15, 0.05  # of a beam's length: what its end sinks by, what is clamped
PERIODS = 3
DEBRIS = 0.01  # of the area: all parts but the largest together
COLUMN = 39  # where comments begin
TURN = "{ rotate = { axis = [1, 0, 0], degrees = 90 } }"  # y upwards becomes z upwards
GRAVITY = ["[gravity]", "acceleration = [0, 0, -9.81]           # [m/s^2]"]


def run(args: argparse.Namespace) -> int:
    """Write the scene, or list those that come with msmpetsc; return the exit status."""
    if args.list:
        titles = shipped_titles()
        print(
            "\n".join(f"{name:{max(map(len, titles))}}  {title}" for name, title in titles.items())
        )
        return 0
    if args.scene is None or (args.mesh is None) == (args.from_scene is None):
        raise InputError(
            "new takes the scene's name and --mesh MESH or --from NAME: msmpetsc new my.toml --mesh my.ply"
        )
    refuse_other_format("new", args.scene, SCENE_NAMES)
    if args.scene.exists() and not args.overwrite:
        raise InputError(f"{args.scene} exists already: --overwrite replaces it")
    if args.from_scene is not None:
        text = f"#:schema {SCHEMA_FILE}\n{shipped_text(args.from_scene)}"
    else:
        text = drafted(args.mesh, args.scene, args.up)
    scene_of(args.scene, text, to_read=False)  # so that nothing is written that run would refuse
    write_whole(args.scene.with_name(SCHEMA_FILE), json.dumps(json_schema(), indent=1) + "\n")
    write_whole(args.scene, text)
    print(f"{args.scene}\nto run it: msmpetsc run {quote(str(args.scene))} --picture")
    return 0


def drafted(mesh: Path, scene: Path, up: str | None) -> str:
    """Return the text of a scene for a mesh, a file or a registry name. Raises InputError.

    up : the mesh's upward axis, "y" or "z"; None: y of glTF, and where the body stands better on y than on z
    """
    source = str(mesh) if str(mesh) in MODELS else path_from(scene, mesh)
    surface = load(source, scene.parent)
    report = examine(surface)
    warnings = check_encloses(surface, report)
    if up is None:
        is_y = (
            mesh.suffix.lower() in Y_BY_DEFINITION
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
    """Return the path of a mesh from its scene's folder. Raises InputError for one elsewhere."""
    folder = scene.parent
    if not mesh.exists():
        locate(str(mesh), Path())  # says what it is not
    if not lies_below(folder, str(mesh.resolve())):
        raise InputError(
            f"{mesh} is not in {folder.resolve()}, nor below it, where a scene has its meshes: "
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
            f"no scene {name!r} comes with msmpetsc{did_you_mean(name, titles)}: msmpetsc new --list"
        )
    return (SHIPPED / f"{name}.toml").read_text(encoding="utf-8")


# ---- the mesh


@dataclass(frozen=True)
class MeshMeasures:
    """Measures of a mesh for its first scene, in metres and with z upwards."""

    up: str  # the upward axis of the file
    unit: float | None  # of that [m]; None where neither metres nor millimetres give a usual body
    sides: Floats  # (3,) of the bounding box
    thickness: float  # mean: twice the volume over the area
    volume: float
    triangles: int
    report: SurfaceReport  # in the unit of the file
    parts: Floats  # (p,) share of the area that each connected part has, the largest first

    @property
    def beam_axis(self) -> int | None:
        """The horizontal axis along which the body is a beam; None for any other."""
        along = int(np.argmax(self.sides))
        return (
            along
            if along < 2 and self.sides[along] >= SLENDER * np.delete(self.sides, along).max()
            else None
        )

    @property
    def unit_words(self) -> str:
        """The unit of the file in words."""
        if self.unit is None:
            return "the unit of the file is unknown"
        return f"the file is taken to be in {'mm' if self.unit == MILLIMETRE else 'm'}"

    @property
    def words(self) -> str:
        """Triangles, boundary and parts in words."""
        boundary, parts = "closed", "1 part"
        if not self.report.closed:
            boundary = f"open ({self.report.boundary_edges} boundary edges)"
        if len(self.parts) > 1:
            parts = f"{len(self.parts)} parts, the largest of {self.parts[0]:.0%} of the area"
        return f"{self.triangles} triangles, {boundary}, {parts}"


def measured(surface: Surface, report: SurfaceReport, up: str) -> MeshMeasures:
    """Measure a surface of a file with the axis ``up`` upwards."""
    sides = np.ptp(surface.points[np.unique(surface.triangles)], axis=0)
    unit = unit_of(float(sides.max()))
    metres = unit or USUAL_SIZE / sides.max()
    faces = trimesh.Trimesh(surface.points, surface.triangles, process=False)
    areas = np.bincount(part_labels(surface), faces.area_faces)
    return MeshMeasures(
        up=up,
        unit=unit,
        sides=metres * (sides[[0, 2, 1]] if up == "y" else sides),
        thickness=metres * (2 * abs(report.volume) / report.area),
        volume=metres**3 * abs(report.volume),
        triangles=len(surface.triangles),
        report=report,
        parts=np.sort(areas / areas.sum())[::-1],
    )


def unit_of(side: float) -> float | None:
    """Return the unit [m] in which a body of this longest side has a usual size, metres before millimetres."""
    return next((unit for unit in (1.0, MILLIMETRE) if USUAL_SIDES[0] <= side * unit <= USUAL_SIDES[1]), None)


def uprightness(surface: Surface, axis: int) -> float:
    """Return how much likelier a body stands with this axis upwards than downwards, in [-1, 1].

    A chair stands well on its feet and badly on its head; lying on its back it does both, a little.
    """
    return stands(surface, axis, 1) - stands(surface, axis, -1)


def stands(surface: Surface, axis: int, way: int) -> float:
    """Return how well a body stands with this axis upwards (way 1) or downwards (-1): the share of
    its ground plan that it stands on, less where it stands on a face rather than on feet.

    That is the convex hull of its lowest points; nothing where its centre is not above it.
    """
    used, plan = np.unique(surface.triangles), np.delete(surface.points, axis, axis=1)
    height = way * surface.points[:, axis]
    height -= height[used].min()
    low = height <= SOLE * height[used].max()
    try:
        hull, ground = ConvexHull(plan[used[low[used]]]), ConvexHull(plan[used])
    except QhullError:  # an edge or a corner
        return 0.0
    areas = trimesh.Trimesh(surface.points, surface.triangles, process=False).area_faces
    centre = areas @ plan[surface.triangles].mean(axis=1) / areas.sum()
    if not (hull.equations[:, :2] @ centre + hull.equations[:, 2] <= 0).all():
        return 0.0
    lowest = surface.triangles[low[surface.triangles].all(axis=1)]
    flat = np.insert(plan, 2, 0.0, axis=1)
    face = (
        trimesh.Trimesh(flat, lowest, process=False).area / hull.volume
    )  # in two dimensions the volume is an area
    return float(hull.volume / ground.volume * (1 - FEET * min(face, 1.0)))


# ---- the scene


def draft(source: str, title: str, mesh: MeshMeasures) -> str:
    """Return the text of a scene for a mesh, ``source`` as the scene will name it."""
    head = [
        f"#:schema {SCHEMA_FILE}",
        "# A first draft by msmpetsc new: every value is to be changed. All keys: msmpetsc keys",
        f"title = {json.dumps(title, ensure_ascii=False)}",
    ]
    moved = _falling(mesh) if mesh.beam_axis is None else _clamped(mesh, mesh.beam_axis)
    return "\n".join([*head, "", *_mesh(source, mesh), "", *_cages(mesh), "", *moved]) + "\n"


def _mesh(source: str, mesh: MeshMeasures) -> list[str]:
    """Return the table of the mesh, with comments on its defects."""
    report = mesh.report
    lines = ["[mesh]", line(f"source = {json.dumps(source, ensure_ascii=False)}", mesh.words)]
    lines.append(f"# {mesh.up} is taken for upwards: msmpetsc new --up says another axis")
    steps = {}  # with the reason
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
            '# open: the winding number decides what is inside; prepare = ["repair"] would close it'
        )
    if len(mesh.parts) > 1 and '"largest_part"' not in steps:
        lines.append(
            '# parts that no cell joins move by themselves; prepare = ["union"] joins those that overlap'
        )
    lines.append(
        line(f"size = {plain(mesh.sides.max(), 5)}", f"longest side [m]; {mesh.unit_words}")
    )
    if mesh.beam_axis is None:
        drop = plain(DROP * mesh.sides[2], 2)
        lines.append(
            line(
                f"base = [0, 0, {drop}]",
                "middle of the bottom at the start [m]: it falls a fifth of its height",
            )
        )
    return lines


def _cages(body: MeshMeasures) -> list[str]:
    aim = body.volume * (ACROSS / body.thickness) ** 3
    count = int(float(plain(min(max(aim, CELLS[0]), CELLS[1]), 1)))
    across = body.thickness * (count / body.volume) ** (1 / 3)
    return [
        "[cages]",
        line(
            f"count = {count}",
            f"cells; a mean thickness of {body.thickness:.2g} m has {across:.1f}",
        ),
    ]


def _falling(body: MeshMeasures) -> list[str]:
    """Return the tables of a body that falls on the ground."""
    height = float(body.sides[2])
    young = SINKING * DENSITY * G * height
    period = 4 * height / math.sqrt(young / DENSITY)  # of waves along the height
    fall = math.sqrt(2 * DROP * height / G)
    ground = [
        "[[obstacle]]",
        line(
            'shape = "plane"',
            "the ground: the body is no beam that lies, so it falls rather than hangs",
        ),
        line("point = [0, 0, 0]", "[m]"),
        line("normal = [0, 0, 1]", "towards the free side"),
        line('response = "penalty"', 'or "reflect", with a restitution'),
        line("friction = 0.5", "Coulomb's coefficient"),
    ]
    material = _material(young, f"its own weight presses it together by about {100 / SINKING:g}%")
    return [*material, "", *_time(2 * fall + PERIODS * period, period), "", *GRAVITY, "", *ground]


def _clamped(body: MeshMeasures, axis: int) -> list[str]:
    """Return the tables of a beam (Euler, Bernoulli) with one end clamped; its section counts as a full rectangle."""
    length, thick = float(body.sides[axis]), float(body.sides[2])
    young = (
        1.5 * DENSITY * G * length**3 / (thick**2 * SAG)
    )  # q l^4 / 8 E I = SAG l under its weight
    period = bending_period(length, thick, young, DENSITY)
    along = np.eye(3, dtype=int)[axis]
    point = ", ".join(f"{CLAMPED * each:g}" for each in along)
    normal = ", ".join(str(-each) for each in along)
    region = f"half_space = {{ point = [{point}], normal = [{normal}] }}, relative = true"
    pin = [
        line("[[pin]]", "the body is long and lies: one end does not move"),
        f"region = {{ {region} }}",
    ]
    material = _material(young, f"its end would sink by about {100 * SAG:g}% of its length")
    return [*material, "", *_time(PERIODS * period, period), "", *GRAVITY, "", *pin]


def _material(young: float, effect: str) -> list[str]:
    return [
        "[material]",
        line(f"young_modulus = {plain(young, 1)}", f"[Pa]; {effect}"),
        line(f"density = {plain(DENSITY, 4)}", "[kg/m^3], as water"),
        line('law = "neo-hookean"', 'a solid; "linear" has the paper\'s springs'),
        line("poisson_ratio = 0.25", "[-]; tissue has 0.45, rubber 0.49"),
    ]


def _time(duration: float, period: float) -> list[str]:
    """Return the table of time for a motion whose slowest part has this period [s]."""
    step = float(plain(period / STEPS_A_PERIOD, 1))
    return [
        "[time]",
        line(f"step = {step:g}", f"[s]; the slowest motion takes about {period:.2g} s"),
        line(f"duration = {step * math.ceil(duration / step):.6g}", "[s]"),
    ]


def line(setting: str, comment: str) -> str:
    """Return a line of TOML with a comment at a fixed column."""
    return f"{setting:{COLUMN - 1}} # {comment}"


def plain(value: float, digits: int) -> str:
    """Return a number with so many digits in short TOML notation: 0.12, 3e5."""
    return f"{value:.{digits}g}".replace("e+0", "e")
