"""The schema of a scene file: frozen, validated tables. What a key means and its unit stand in its description."""

from collections.abc import Iterator
from itertools import chain
from typing import Any, Literal, NamedTuple

from pydantic import Field, field_validator, model_validator

from msmpetsc.scene.body import CagesTable, Material, MeshTable, OwnMaterial, PartTable
from msmpetsc.scene.motion import AnchorTable, Force, Gravity, Pin, Start
from msmpetsc.scene.obstacles import BARRIER, ObstacleTable, SelfContactTable
from msmpetsc.scene.problems import Broken, KeyPath, rule
from msmpetsc.scene.time import Time, one_state, unlike_the_integrator
from msmpetsc.scene.values import (
    Count,
    Direction,
    FileName,
    GroupName,
    ListOf,
    NotNegative,
    PresetName,
    Table,
    Vector,
)

MOST_CONTRAST = 1e6  # of parts: at 1e8 a squashed body took newton over 1,200 iterations a step
OF_REGIONS = ("part", "pin", "anchor", "force")  # tables that take a region of one body, or of all


class BodyTable(Table):
    """One of several bodies. Regions of its tables are of this body alone."""

    mesh: MeshTable = Field(description="its closed surface")
    material: OwnMaterial | None = Field(
        None, description="what it is made of, where that is not the scene's material"
    )
    part: ListOf[PartTable] = Field((), description="cells of it of another material")
    start: Start | None = Field(
        None, description="how it is at time 0; as the scene's start says if absent"
    )
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
    others |= {
        f"body.{number}.material": body.material
        for number, body in enumerate(scene.body)
        if body.material
    }
    for key, other in others.items():
        for name in Material.one_of:
            if getattr(other, name) is not None and getattr(scene.material, name) is None:
                words = f"may give {name} only where material does, as {key} does"
                yield key.partition(".")[0], rule(words, "material")
        if other.poisson_ratio is not None and scene.material.poisson is None:
            words = f'may give poisson_ratio only where material.law = "neo-hookean", as {key} does'
            yield key.partition(".")[0], rule(words, "material")
    for name in (*Material.one_of, "density"):
        values = {
            key: value
            for key, table in others.items()
            if (value := getattr(table, name)) is not None
        }
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


class Solver(Table):
    """Solver of a step."""

    preset: PresetName = Field("newton", min_length=1, description="named set of PETSc options")
    error: float | None = Field(
        None, gt=0, lt=1, description="relative error of a step to aim at [-]"
    )
    max_iterations: Count | None = Field(None, description="outer iterations allowed in a step [-]")


class Safety(Table):
    """Recovery of steps that fail."""

    on_failure: Literal["stop", "substep", "fallback"] = Field(
        "stop",
        description="stop the run; take that step in shorter ones; or solve it with a slower, robust method",
    )


class Probe(Table):
    """A point of the body that is followed."""

    one_of = ("point", "group")
    name: FileName = Field(description="of its columns in `msmpetsc series`")
    point: Vector | None = Field(
        None, description="where it is at rest; it goes with the cell that it lies in [m]"
    )
    group: GroupName | None = Field(
        None,
        description="name that a mesh gives to triangles: the point of them nearest to their middle [-]",
    )


class Output(Table):
    """Choice of what the result file stores beside the lattice."""

    surface: bool = Field(True, description="store the surface of every frame")
    stress: bool = Field(
        False,
        description='store stress and strain energy of every frame; with material.law = "neo-hookean"',
    )
    probe: ListOf[Probe] = Field((), description="points of the body whose places are stored")
    every: Count = Field(1, description="store every N-th step only, and the last [-]")

    @field_validator("probe")
    @classmethod
    def _has_distinct_names(cls, probes: tuple[Probe, ...]) -> tuple[Probe, ...]:
        if len({probe.name for probe in probes}) < len(probes):
            raise rule("must have a name of its own for each")
        return probes


class Picture(Table):
    """View of the result in pictures."""

    eye: Direction | None = Field(
        None,
        description="direction from the body to the eye, of any length; across its longer side if absent [-]",
    )
    times: ListOf[NotNegative] = Field(
        (), description="moments drawn beside the start [s]; chosen by their energies if absent"
    )


class SceneFile(Table):
    """What may stand in a scene file; ``SceneFile.model_json_schema()`` is its schema."""

    one_of = ("mesh", "body")
    title: str = Field("", description="for the reader")
    mesh: MeshTable | None = Field(None, description="the closed surface of the one body")
    cages: CagesTable = Field(description="the cells that fill it")
    material: Material = Field(description="what it is made of")
    time: Time = Field(description="time step and duration")
    body: ListOf[BodyTable] = Field(
        (), min_length=1, description="each of several bodies, in place of mesh"
    )
    part: ListOf[PartTable] = Field((), description="cells of another material")
    start: Start | None = Field(
        None, description="how it is at time 0; at rest in its rest shape if absent"
    )
    gravity: Gravity | None = Field(None, description="a uniform field; none if absent")
    obstacle: ListOf[ObstacleTable] = Field((), description="what nodes bounce off")
    self_contact: SelfContactTable | None = Field(
        None, description="what keeps the surface from crossing itself"
    )
    pin: ListOf[Pin] = Field((), description="nodes that stay where they are")
    anchor: ListOf[AnchorTable] = Field((), description="nodes led along a path")
    force: ListOf[Force] = Field((), description="forces on parts of the body")
    solver: Solver = Field(
        default_factory=lambda: Solver.model_validate({}), description="how a step is solved"
    )
    safety: Safety = Field(
        default_factory=lambda: Safety.model_validate({}),
        description="what is done about a failed step",
    )
    output: Output = Field(
        default_factory=lambda: Output.model_validate({}), description="what is stored"
    )
    picture: Picture = Field(
        default_factory=lambda: Picture.model_validate({}), description="how the result is drawn"
    )

    @model_validator(mode="before")
    @classmethod
    def _of_one_state(cls, data: Any) -> Any:
        return one_state(data)

    def broken_rules(self) -> Iterator[Broken]:
        """Yield the rules that the tables break among each other."""
        if self.output.stress and self.material.poisson is None:
            words = f'may not have stress = true with material.law = "{self.material.law}": springs have no stress'
            yield "output", rule(words, "material")
        yield from chain(
            unlike_the_material(self), regions_of_no_body(self), unlike_the_integrator(self)
        )

    @property
    def stored(self) -> int:
        """Return the number of frames, frame 0 included."""
        return self.stored_until(self.time.steps)

    def stored_until(self, step: int) -> int:
        """Return the number of frames of the first steps: of every ``every``-th and of the last."""
        every = self.output.every
        return 1 + (-(-step // every) if step == self.time.steps else step // every)

    @property
    def meshes(self) -> dict[KeyPath, MeshTable]:
        """Return the surface of each body, by the path of its key."""
        if self.mesh is not None:
            return {("mesh",): self.mesh}
        return {("body", number, "mesh"): body.mesh for number, body in enumerate(self.body)}

    @property
    def touching(self) -> SelfContactTable | None:
        """How surfaces touch: those of the bodies, or where these may cross, theirs and obstacles'; None if none do."""
        meets = any(obstacle.response == BARRIER for obstacle in self.obstacle)
        return self.self_contact or (SelfContactTable.model_validate({}) if meets else None)

    @property
    def starts(self) -> list[Start | None]:
        """Return the starts of all bodies at time 0."""
        return [body.start or self.start for body in self.body] or [self.start]

    def tables(self, kind: str) -> Iterator[OfBody]:
        """Yield the tables of a kind: the scene's own, which are of all bodies, then each body's."""
        for number, table in enumerate(getattr(self, kind)):
            yield OfBody((kind, number), None, table)
        for body, tables in enumerate(self.body):
            for number, table in enumerate(getattr(tables, kind)):
                yield OfBody(("body", body, kind, number), body, table)

    def named_files(self) -> Iterator[tuple[KeyPath, str]]:
        """Yield key path and name of each file that it names; a mesh's name may be one of the registry's too."""
        solids = {
            ("obstacle", number, "mesh"): o.mesh
            for number, o in enumerate(self.obstacle)
            if o.mesh is not None
        }
        for path, mesh in (self.meshes | solids).items():
            yield (*path, "source"), mesh.source
        for path, _, table in chain.from_iterable(self.tables(kind) for kind in OF_REGIONS):
            if isinstance(table.region.painted, str):
                yield (*path, "region", "painted"), table.region.painted
