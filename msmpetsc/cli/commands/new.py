"""``msmpetsc new``: write a first scene for a mesh, or copy a scene that comes with msmpetsc.

The body falls on the ground. Lengths grow with the body's height, and times with its square root,
so that bodies of all sizes move alike.
"""

import argparse
import json
import tomllib
from pathlib import Path
from shlex import quote

import numpy as np

import msmpetsc
from msmpetsc.app.checks import SCENE_NAMES, refuse_other_format
from msmpetsc.build import USUAL_SIDES
from msmpetsc.comm import log
from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.geometry.registry import MODELS, load, locate
from msmpetsc.geometry.surface import check_encloses, examine
from msmpetsc.results.disk import refuse_existing, write_whole
from msmpetsc.scene.key_table import SCHEMA_FILE, json_schema
from msmpetsc.scene.reading import lies_below, scene_of

# folder of the shipped scenes, which a wheel also has; in a clone a link to scenes/
SHIPPED = Path(msmpetsc.__file__).parent / "shipped"
# formats whose definition has y upwards
Y_UP_FORMATS = (".glb", ".gltf")
DRAFT = """\
#:schema {schema}
# A first draft by msmpetsc new: adjust every value. All keys: msmpetsc keys
title = {title}

[mesh]
source = {source}
prepare = [{prepare}]
size = {size:.5g} # longest side [m]; the file is taken to be in {unit}
base = [0, 0, {drop:.2g}] # centre of the bottom face [m]: the body falls a fifth of its height

[cages]
count = 3000 # cells

[material]
young_modulus = {young_modulus:.1g} # [Pa]; its own weight compresses it by about 1%
density = 1000 # [kg/m^3], as water
law = "neo-hookean" # a solid; "linear": the paper's springs
poisson_ratio = 0.25 # [-]; tissue has 0.45, rubber 0.49

[time]
step = {step:.1g} # [s]; a fortieth of the period of a wave along its height
duration = {duration:.2g} # [s]

[gravity]
acceleration = [0, 0, -9.81] # [m/s^2]

[[obstacle]]
shape = "plane" # the ground
point = [0, 0, 0] # [m]
normal = [0, 0, 1] # towards the free side
response = "penalty" # or "reflect", with a restitution
friction = 0.5 # Coulomb's coefficient
"""


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
    refuse_existing(args.scene, args.overwrite)
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

    up : the mesh's upward axis, "y" or "z"; None for y in glTF files and z in all other files
    """
    source = str(mesh) if str(mesh) in MODELS else path_from(scene, mesh)
    surface = load(source, scene.parent)
    report = examine(surface)
    for warning in check_encloses(surface, report):
        log.warning("%s: %s", mesh, warning)
    up = up or ("y" if mesh.suffix.lower() in Y_UP_FORMATS else "z")
    sides = np.ptp(surface.points[np.unique(surface.triangles)], axis=0)
    unit, metres = ("mm", 1e-3) if sides.max() > USUAL_SIDES[1] else ("m", 1.0)
    log.info(
        "the file is taken to be in %s, its longest side as %.4g m: mesh.size in the scene sets it",
        unit, metres * sides.max(),
    )  # fmt: skip
    log.info("%s is taken for upwards: --up says another axis", up)
    steps = []
    if report.inconsistent_edges or report.volume < 0:
        steps.append('"orient"')
    if up == "y":
        steps.append("{ rotate = { axis = [1, 0, 0], degrees = 90 } }")
    height = metres * sides["xyz".index(up)]
    return DRAFT.format(
        schema=SCHEMA_FILE,
        title=json.dumps(scene.stem, ensure_ascii=False),
        source=json.dumps(source, ensure_ascii=False),
        prepare=", ".join(steps),
        size=metres * sides.max(),
        unit=unit,
        drop=0.2 * height,
        young_modulus=1e6 * height,
        step=3e-3 * height**0.5,
        duration=0.8 * height**0.5,
    )


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
    return {
        path.stem: tomllib.loads(path.read_text(encoding="utf-8")).get("title", "")
        for path in files
    }


def shipped_text(name: str) -> str:
    """Return the text of a shipped scene. Raises InputError for an unknown name."""
    titles = shipped_titles()
    if name not in titles:
        raise InputError(
            f"no scene {name!r} comes with msmpetsc{did_you_mean(name, titles)}: "
            "msmpetsc new --list"
        )
    return (SHIPPED / f"{name}.toml").read_text(encoding="utf-8")
