"""``msmpetsc new``: a first scene for a mesh of one's own, or a copy of one that comes with msmpetsc."""

import argparse
import json
from pathlib import Path

from msmpetsc.app.checks import SCENE_NAMES, refuse_other_format
from msmpetsc.cli.ranks import refuse_ranks
from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.geometry.registry import MODELS, load, locate
from msmpetsc.geometry.surface import check_encloses, examine
from msmpetsc.results.disk import whole_file, write_whole
from msmpetsc.scene.keys import SCHEMA_FILE, json_schema
from msmpetsc.scene.reading import lies_below, scene_of
from msmpetsc.scene.shipped import shipped_text, shipped_titles
from msmpetsc.study.new_scene import MeshMeasures, draft, measured, upwards


def run(args: argparse.Namespace) -> int:
    """Write the scene, or list those that come with msmpetsc; return the exit status."""
    refuse_ranks("new", "it measures a mesh on one process")
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
    source, suffix = (str(mesh), "") if is_named else (beside(mesh, scene), Path(mesh.name.removesuffix(".gz")).suffix)
    surface = load(source, scene.parent)
    warnings = check_encloses(surface, examine(surface))
    measures = measured(surface, suffix)
    log_findings(mesh, measures, warnings)
    log.info("%s", upwards(measures))
    return draft(source, scene.stem, measures)


def log_findings(mesh: Path, measures: MeshMeasures, warnings: list[str]) -> None:
    """Log what was found of a mesh; what the scene does about it stands in its comments."""
    count, state = len(measures.parts), "closed" if measures.report.closed else "open"
    parts = f"{count} parts, the largest of {measures.parts[0]:.0%} of the area" if count > 1 else "1 part"
    log.info("%s: %d triangles, %s, %s", mesh, measures.triangles, state, parts)
    for warning in warnings:
        log.warning("%s: %s", mesh, warning)
    if warnings or count > 1:
        log.info("what the scene does about that stands in its comments")


def beside(mesh: Path, scene: Path) -> str:
    """Return the path of a mesh from the folder of its scene, in or below which it must be. Raises InputError."""
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
