"""The arguments of what brings scenes and meshes: ``fetch``."""

from msmpetsc.cli.options.values import Commands


def add_fetch(commands: Commands) -> None:
    """Add ``msmpetsc fetch``."""
    parser = commands.add_parser("fetch", help="download named meshes, or list them")
    parser.add_argument("names", nargs="*", metavar="NAME", help="a model, see --list")
    parser.add_argument("--list", action="store_true", help="list the models and where they lie")
