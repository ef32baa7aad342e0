"""``msmpetsc new``: a first scene for a mesh of one's own, or a copy of one that comes with msmpetsc."""

import argparse
import json
from pathlib import Path

import msmpetsc
from msmpetsc.app.checks import SCENE_NAMES, refuse_other_format
from msmpetsc.comm import log
from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.geometry.registry import MODELS, load, locate
from msmpetsc.geometry.surface import check_encloses, examine
from msmpetsc.results.disk import whole_file, write_whole
from msmpetsc.scene.key_table import SCHEMA_FILE, json_schema
from msmpetsc.scene.reading import lies_below, scene_of
from msmpetsc.scene.toml import toml_of
from msmpetsc.study.new_scene import draft, measured, upwards

SHIPPED = Path(msmpetsc.__file__).parent / "shipped"  # the scenes that a wheel holds, too; in a clone a link to scenes/


def run(args: argparse.Namespace) -> int:
    """Write the scene, or list those that come with msmpetsc; return the exit status."""
    if args.list:
        titles = shipped_titles()
        print("\n".join(f"{name:{max(map(len, titles))}}  {title}" for name, title in titles.items()))
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
        text = drafted(args.mesh, args.scene)
    scene_of(args.scene, text, to_read=False)  # so that nothing is written that run would refuse
    write(args.scene, text)
    print(f"{args.scene}\nto run it: msmpetsc run {args.scene} --picture")
    return 0


def drafted(mesh: Path, scene: Path) -> str:
    """Return the text of a scene for a mesh, a file or a registry name. Raises InputError."""
    is_named = str(mesh) in MODELS
    source, suffix = (str(mesh), "") if is_named else (beside(mesh, scene), mesh.suffix)
    surface = load(source, scene.parent)
    warnings = check_encloses(surface, examine(surface))
    measures = measured(surface, suffix)
    count, state = len(measures.parts), "closed" if measures.report.closed else "open"
    parts = f"{count} parts, the largest of {measures.parts[0]:.0%} of the area" if count > 1 else "1 part"
    log.info("%s: %d triangles, %s, %s", mesh, measures.triangles, state, parts)
    for warning in warnings:
        log.warning("%s: %s", mesh, warning)
    if warnings or count > 1:
        log.info("what the scene does about that stands in its comments")
    log.info("%s", upwards(measures))
    return draft(source, scene.stem, measures)


def beside(mesh: Path, scene: Path) -> str:
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


def write(path: Path, text: str) -> None:
    """Write the scene, and beside it the schema that its first line names. Raises InputError."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
        write_whole(path.with_name(SCHEMA_FILE), json.dumps(json_schema(), indent=1) + "\n")


def shipped_titles() -> dict[str, str]:
    """Return the title of each scene that comes with the package. Raises InputError for none."""
    files = sorted(SHIPPED.glob("*.toml"))
    if not files:
        raise InputError(f"{SHIPPED} has no scenes: this msmpetsc was installed without them")
    return {path.stem: toml_of(path.read_text(encoding="utf-8")).get("title", "") for path in files}


def shipped_text(name: str) -> str:
    """Return the text of a scene that comes with the package. Raises InputError for a name that is none."""
    titles = shipped_titles()
    if name not in titles:
        raise InputError(f"no scene {name!r} comes with msmpetsc{did_you_mean(name, titles)}: msmpetsc new --list")
    return (SHIPPED / f"{name}.toml").read_text(encoding="utf-8")
