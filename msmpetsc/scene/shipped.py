"""The scenes that come with the package: those of scenes/, which a wheel holds, too."""

from pathlib import Path

from msmpetsc.errors import InputError, did_you_mean
from msmpetsc.scene.toml import toml_of

FOLDER = Path(__file__).parent.parent / "shipped"  # in a clone a link to scenes/


def shipped_titles() -> dict[str, str]:
    """Return the title of each shipped scene by its name. Raises InputError where the package lacks them."""
    files = sorted(FOLDER.glob("*.toml"))
    if not files:
        raise InputError(f"{FOLDER} has no scenes: this msmpetsc was installed without them")
    return {path.stem: toml_of(path.read_text(encoding="utf-8")).get("title", "") for path in files}


def shipped_text(name: str) -> str:
    """Return the text of a shipped scene. Raises InputError for a name that is none."""
    titles = shipped_titles()
    if name not in titles:
        raise InputError(f"no scene {name!r} comes with msmpetsc{did_you_mean(name, titles)}: msmpetsc new --list")
    return (FOLDER / f"{name}.toml").read_text(encoding="utf-8")
