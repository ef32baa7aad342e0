"""Several bodies in one scene: a table of each, and which table is of which body."""

from collections.abc import Iterator
from typing import Any, NamedTuple

from pydantic import Field

from msmpetsc.scene.body import Material, MeshTable, OwnMaterial, PartTable
from msmpetsc.scene.motion import AnchorTable, Force, Pin, Start
from msmpetsc.scene.problems import Broken, KeyPath, rule
from msmpetsc.scene.values import ListOf, Table

MOST_CONTRAST = 1e6  # of parts: at 1e8 a squashed body took newton over 1,200 iterations a step
OF_REGIONS = ("part", "pin", "anchor", "force")  # tables that take a region of one body, or of all


class BodyTable(Table):
    """One of several bodies. Regions of its tables are of this body alone."""

    mesh: MeshTable = Field(description="its closed surface")
    material: OwnMaterial | None = Field(None, description="what it is made of, where that is not the scene's material")
    part: ListOf[PartTable] = Field((), description="cells of it of another material")
    start: Start | None = Field(None, description="how it is at time 0; as the scene's start says if absent")
    pin: ListOf[Pin] = Field((), description="nodes of it that stay where they are")
    anchor: ListOf[AnchorTable] = Field((), description="nodes of it led along a path")
    force: ListOf[Force] = Field((), description="forces on parts of it")


class OfBody(NamedTuple):
    """A table that takes a region, and whose nodes or cells it means.

    path : of its key in the scene
    body : number of the body; None: of all
    """

    path: KeyPath
    body: int | None
    table: Any

    @property
    def key(self) -> str:
        """Return the path as messages have it, "body.1.pin.0"."""
        return ".".join(map(str, self.path))


def held_by(scene: Any) -> Iterator[OfBody]:
    """Yield the tables of pins, then of anchors: of two that hold a node the first has it."""
    for kind in ("pin", "anchor"):
        yield from scene.tables(kind)


def unlike_the_material(scene: Any) -> Iterator[Broken]:
    """Yield the rules that bodies and parts break beside the material.

    Stiffness and Young's modulus are two ways to name all springs.
    """
    others: dict[str, OwnMaterial] = {part.key: part.table for part in scene.tables("part")}
    others |= {f"body.{number}.material": body.material for number, body in enumerate(scene.body) if body.material}
    for key, other in others.items():
        for name in Material.one_of:
            if getattr(other, name) is not None and getattr(scene.material, name) is None:
                words = f"may give {name} only where material does, as {key} does"
                yield key.partition(".")[0], rule(words, "material")
        if other.poisson_ratio is not None and scene.material.poisson is None:
            words = f'may give poisson_ratio only where material.law = "neo-hookean", as {key} does'
            yield key.partition(".")[0], rule(words, "material")
    for name in (*Material.one_of, "density"):
        values = {key: value for key, table in others.items() if (value := getattr(table, name)) is not None}
        given = [*values.values(), *filter(None, [getattr(scene.material, name)])]
        if values and max(given) > MOST_CONTRAST * min(given):
            yield (
                next(reversed(values)).partition(".")[0],
                rule(
                    f"has {name} of {min(given):g} to {max(given):g} in one run: more than {MOST_CONTRAST:g} to 1, "
                    "which is as good as rigid, is not solved; pin or lead the stiff part"
                ),
            )


def regions_of_no_body(scene: Any) -> Iterator[Broken]:
    """Yield the rules that regions which are of one body break in tables of all bodies."""
    for kind in OF_REGIONS:
        for number, table in enumerate(getattr(scene, kind) if scene.body else ()):
            if table.region.relative or table.region.painted is not None:
                sort = "relative" if table.region.relative else "painted"
                words = f"may have no {sort} region beside [[body]], as {kind}.{number} has: whose it is only "
                yield kind, rule(f"{words}[[body.{kind}]] says", "body")
