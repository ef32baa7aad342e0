"""The forces on a body at a frame: loads, reactions of pins and anchors, pushes of obstacles and of the surface.

They are those of the step that ended last: its inertia, and friction as it had it. Where there is none, as at the start
and in explicit steps, nothing that is held accelerates, and obstacles push without friction.
"""

from typing import Any

import numpy as np

from msmpetsc.backend.arrays import Indices, Positions, Rows, to_host
from msmpetsc.build import Model
from msmpetsc.constraints.reactions import sums_by
from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.environment import Environment
from msmpetsc.scene.reading import Scene
from msmpetsc.solve.nonlinear.step import StepResult


class Forces:
    """The fields of forces that a frame has (fields.Frame), by the names of those that the scene has a use for."""

    def __init__(self, scene: Scene, model: Model, environment: Environment, elasticity: Elasticity):
        self.comm, self.model, self.environment = model.lattice.table.comm, model, environment
        self.elasticity = elasticity
        self.pushing = [number for number, obstacle in enumerate(scene.obstacle) if obstacle.response != "exchange"]
        bodies = len(model.lattice.first_of_body) if model.collision else 0
        held = len(model.holders.keys)
        rows = {"reaction": held, "torque": held, "push": len(model.obstacles), "contact_push": bodies}
        self.rows = {name: count for name, count in rows.items() if count}

    def __call__(self, q: Positions, time: float, sides: Indices | None, step: StepResult | None) -> dict[str, Any]:
        """Return the fields at q (l, 3) [m], where a step ended at a time [s] with these contact faces (collective)."""
        environment, owned = self.environment, self.model.lattice.owned
        problem = step.problem if step else None
        contact = problem.contact if problem else environment.push(time, sides)
        load = environment.load(time)
        sums = {"load": to_host(load.sum(axis=0)), **self._pushes(q, contact)}
        if "reaction" in self.rows:
            held = (self._held(q, contact, step) - load) * environment.fixed_at(time)[:owned, None]
            sums["reaction"] = self.model.holders.totals(held)
            sums["torque"] = self.model.holders.torques(q[:owned], held, self._torque_points(time))
        return {name: self.comm.allreduce(sums[name]) for name in sums if name == "load" or name in self.rows}

    def _torque_points(self, time: float) -> Positions:
        """Return the points (a, 3) [m] about which the torques of pins and anchors are counted, which these lead."""
        points, anchors = self.model.holders.centers.copy(), self.model.anchors
        for row, anchor in enumerate(anchors, len(points) - len(anchors)):
            points[row] = anchor.path.center + anchor.path.value_at(time)[:3]
        return points

    def _held(self, q: Positions, contact: Contact | None, step: StepResult | None) -> Rows:
        """Return what would hold this rank's nodes where they are, beside the loads (owned, 3) [N]."""
        held, owned = np.zeros_like(q), self.model.lattice.owned
        self.elasticity.add_gradient(q, held)
        if contact:
            contact.add_gradient(q, held)
        held = held[:owned]
        if step and step.viscous is not None:
            held += step.viscous
        if step and step.problem:
            held += self.model.lattice.mass[:, None] * (q[:owned] - step.problem.y[:owned]) / step.tau**2
        return held

    def _pushes(self, q: Positions, contact: Contact | None) -> dict[str, Any]:
        """Return the pushes of obstacles (o, 3) and of contact on bodies (b, 3) on this rank's nodes with [N]."""
        lattice, owned = self.model.lattice, self.model.lattice.owned
        push, penalties = np.zeros((len(self.model.obstacles), 3)), self.environment.penalties
        for state in contact.states if contact else ():
            which = next(k for k, penalty in enumerate(penalties) if penalty.obstacle is state.obstacle)
            gradient = np.zeros_like(q[:owned])
            state.add_gradient(q[:owned], gradient)
            push[self.pushing[which]] -= to_host(gradient.sum(axis=0))
        bodies = len(lattice.first_of_body)
        touching = np.zeros((bodies, 3))
        if contact and contact.surface:
            own = np.zeros_like(q[:owned])
            contact.surface.add_gradient(q, own)
            touching -= sums_by(lattice.body[:owned], own, bodies)
        return {"push": push, "contact_push": touching}
