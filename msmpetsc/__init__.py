"""Elastic bodies from closed surface meshes: mass-spring lattices stepped with PETSc."""

from typing import TYPE_CHECKING, Any

# the public names of FROM, for type checkers
if TYPE_CHECKING:
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
# import path of each public name; imported on first use, as `open` needs few packages
FROM = {
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
    """Import a public name on its first use; raise InputError for a missing package."""
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
    """Return Python's own names and all public names, whether imported yet or not."""
    return sorted({*FROM, *(name for name in globals() if name.startswith("__"))})
