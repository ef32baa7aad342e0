"""The arguments of what brings scenes and meshes: ``new``, ``keys``, ``schema`` and ``fetch``."""

from msmpetsc.cli.options.values import Commands, file_argument


def add_new(commands: Commands) -> None:
    """Add ``msmpetsc new``."""
    parser = commands.add_parser(
        "new",
        help="write a first scene for a mesh",
        description="Measure a mesh and write a commented scene that runs at once, or copy one that comes with "
        "msmpetsc; beside it the schema by which editors complete its keys.",
    )
    parser.add_argument("scene", nargs="?", type=file_argument, metavar="SCENE.toml", help="what is written")
    parser.add_argument(
        "--mesh",
        type=file_argument,
        metavar="MESH",
        help="a mesh file in or below the scene's folder, or a model",
    )
    parser.add_argument("--from", dest="from_scene", metavar="NAME", help="copy this scene, see --list")
    parser.add_argument("--list", action="store_true", help="list the scenes that come with msmpetsc")
    parser.add_argument("--overwrite", action="store_true", help="replace SCENE.toml if it exists")


def add_keys(commands: Commands) -> None:
    """Add ``msmpetsc keys``."""
    parser = commands.add_parser(
        "keys",
        help="list the keys of a scene",
        description="List the keys of a scene, or of one of its tables: unit, default, range, meaning.",
    )
    parser.add_argument("table", nargs="?", metavar="TABLE", help="a table or a key: material, pin.region, time.step")


def add_schema(commands: Commands) -> None:
    """Add ``msmpetsc schema``."""
    commands.add_parser("schema", help="print the JSON schema of a scene, for editors")


def add_fetch(commands: Commands) -> None:
    """Add ``msmpetsc fetch``."""
    parser = commands.add_parser("fetch", help="download named meshes, or list them")
    parser.add_argument("names", nargs="*", metavar="NAME", help="a model, see --list")
    parser.add_argument("--list", action="store_true", help="list the models and where they lie")
