"""Several bodies in one scene: a table of each, and which table is of which body."""

from collections.abc import Iterator
from typing import Any, NamedTuple

from pydantic import Field, ValidationInfo

from msmpetsc.scene.body import MeshTable, OwnMaterial, PartTable, refuse_unlike
from msmpetsc.scene.motion import AnchorTable, Force, Pin, Start
from msmpetsc.scene.problems import KeyPath, rule
from msmpetsc.scene.statics import refuse_functions, refuse_motion
from msmpetsc.scene.values import ListOf, Table

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
        """The path as messages have it, "body.1.pin.0"."""
        return ".".join(map(str, self.path))


def tables_of(scene: Any, kind: str) -> Iterator[OfBody]:
    """Yield the tables of a kind of a scene: its own, which are of all bodies, then those of each body."""
    for number, table in enumerate(getattr(scene, kind)):
        yield OfBody((kind, number), None, table)
    for body, tables in enumerate(scene.body):
        for number, table in enumerate(getattr(tables, kind)):
            yield OfBody(("body", body, kind, number), body, table)


def as_the_material(cls: Any, tables: tuple[Any, ...], info: ValidationInfo) -> tuple[Any, ...]:
    """Refuse bodies and parts that do not go with the material (a validator of ``body`` and ``part``)."""
    known = {**info.data, str(info.field_name): tables}
    others: dict[str, OwnMaterial] = {f"part.{number}": part for number, part in enumerate(known.get("part", ()))}
    for number, body in enumerate(known.get("body", ())):
        if body.material is not None:
            others[f"body.{number}.material"] = body.material
        others |= {f"body.{number}.part.{which}": part for which, part in enumerate(body.part)}
    refuse_unlike(info.data.get("material"), others)
    return tables


def no_moving_body(cls: Any, bodies: tuple[BodyTable, ...], info: ValidationInfo) -> tuple[BodyTable, ...]:
    """Refuse bodies that start in motion, or whose forces go by the state, in statics (a validator of ``body``)."""
    for number, body in enumerate(bodies):
        refuse_motion(body.start, info, f"body.{number}.start ")
        refuse_functions(body.force, info, f"body.{number}.")
    return bodies


def of_all_bodies(cls: Any, tables: tuple[Any, ...], info: ValidationInfo) -> tuple[Any, ...]:
    """Refuse regions that are of one body in tables of all (a validator of these)."""
    for number, table in enumerate(tables if info.data.get("body") else ()):
        if table.region.relative or table.region.painted is not None:
            kind = "relative" if table.region.relative else "painted"
            raise rule(
                f"may have no {kind} region beside [[body]], as {info.field_name}.{number} has: whose it is only "
                f"[[body.{info.field_name}]] says",
                "body",
            )
    return tables
