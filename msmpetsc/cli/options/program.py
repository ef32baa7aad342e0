"""The arguments of what is about the program itself: ``doctor`` and ``completion``."""

from msmpetsc.cli.options.values import Commands

SHELLS = ("bash", "zsh", "fish")


def add_doctor(commands: Commands) -> None:
    """Add ``msmpetsc doctor``."""
    commands.add_parser(
        "doctor",
        help="say what is installed, and how to get what is not",
        description="Examine PETSc, MPI, the device, HDF5, the kernels' cache, packages and meshes. "
        "Exit status 1: a run lacks something that it needs.",
    )


def add_completion(commands: Commands) -> None:
    """Add ``msmpetsc completion``."""
    parser = commands.add_parser(
        "completion",
        help="print the completion of a shell",
        description="Print the script by which a shell completes commands, options and files.",
    )
    parser.add_argument("shell", choices=SHELLS)
