"""Elastic bodies from closed surface meshes: mass-spring lattices stepped with PETSc."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what FROM says, for type checkers
    from msmpetsc.app.start import Simulation as Simulation
    from msmpetsc.app.start import frames as frames
    from msmpetsc.app.start import run as run
    from msmpetsc.extensions import register_force as register_force
    from msmpetsc.extensions import register_obstacle as register_obstacle
    from msmpetsc.extensions import register_preset as register_preset
    from msmpetsc.fields import Frame as Frame
    from msmpetsc.results.reader import Result as Result
    from msmpetsc.scene.reading import Scene as Scene

    open = Result

__version__ = "0.2.0"
FROM = {  # what is imported when it is first used: reading a result needs numpy and h5py alone
    "Frame": "msmpetsc.fields.Frame",
    "Result": "msmpetsc.results.reader.Result",
    "Scene": "msmpetsc.scene.reading.Scene",
    "Simulation": "msmpetsc.app.start.Simulation",
    "frames": "msmpetsc.app.start.frames",
    "open": "msmpetsc.results.reader.Result",
    "register_force": "msmpetsc.extensions.register_force",
    "register_obstacle": "msmpetsc.extensions.register_obstacle",
    "register_preset": "msmpetsc.extensions.register_preset",
    "run": "msmpetsc.app.start.run",
}


def __getattr__(name: str) -> Any:
    """Import a public name on its first use. Raises InputError for a package that is missing."""
    if name not in FROM:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    from msmpetsc.errors import as_expected

    module, _, attribute = FROM[name].rpartition(".")
    try:
        return getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise as_expected(error) or error from None


def __dir__() -> list[str]:
    """Return the public names, those not imported yet included, and Python's own."""
    return sorted({*FROM, *(name for name in globals() if name.startswith("__"))})
