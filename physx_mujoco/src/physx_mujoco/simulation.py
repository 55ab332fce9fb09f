"""The engine MuJoCo: contacts, limits and friction are constraints of its solver.

Steps are semi-implicit Euler, with implicit damping and springs (MuJoCo's integrator `discrete`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import mujoco
import numpy as np

from physx_core.errors import UnknownOptionError
from physx_core.typing import Records, Vector
from physx_mujoco.algorithms import MujocoAlgorithms
from physx_mujoco.contact_rows import ContactRows
from physx_mujoco.drives import Drives
from physx_mujoco.model import SPARE, ModelBuilder, WorldModel, quaternion_of
from physx_mujoco.pictures import Pictures
from physx_mujoco.robot import MujocoRobot, Running
from physx_sim import CONTACT, FEATURES, Camera, Simulation, World
from physx_sim.engines import (
    RK4_LACKS,
    Algorithms,
    Bond,
    Parts,
    RobotBackend,
    RobotSimulation,
    check_rk4,
    layout_of,
    read_parts,
)
from physx_sim.errors import FeatureNotSupportedError, SimulationError

_SOLVERS = {
    "newton": mujoco.mjtSolver.mjSOL_NEWTON,
    "cg": mujoco.mjtSolver.mjSOL_CG,
    "pgs": mujoco.mjtSolver.mjSOL_PGS,
}
_FULL = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)


class MujocoBackend(RobotBackend):
    """MuJoCo. Contact solvers: ``newton`` (default), ``cg`` and ``pgs``; one detector.

    Meshes collide as their convex hulls. Nothing bounces. MuJoCo's log, a file in the working
    directory, is switched off in this process: what MuJoCo warns about is an error here.
    """

    def build(self, world: World, seed: int | None = None) -> Simulation:
        """Build a simulation; MuJoCo is deterministic, so the seed has no effect.

        Raises:
            ModelError: If a robot or mesh cannot be loaded; the message gives the reason.
            FeatureNotSupportedError: If the world needs a feature that MuJoCo does not have.
            UnknownOptionError: If there is no solver with that name.
        """
        return MujocoSimulation(world)


class MujocoSimulation(RobotSimulation[MujocoRobot]):
    """A world in MuJoCo."""

    engine = "mujoco"
    lacks: ClassVar[frozenset[str]] = frozenset(
        {"derivatives", "restitution", "rolling", "step_derivatives"}
    )
    caveats: ClassVar[Mapping[str, str]] = {
        "attachments": f"while it runs, {SPARE} more than at the start; soft",
        "cameras": "with EGL or OSMesa",
        "contacts": "soft",
        "body_contacts": "soft",
        "joint_wrenches": "not while anything is attached",
        "mesh_contacts": "as convex hulls",
        "torsional_friction": "soft; sliding, turning and rolling share one bound",
    }

    def __init__(self, world: World) -> None:
        """Build the world; raises the same errors as the backend's `build`."""
        if world.solver is not None and world.solver not in _SOLVERS:
            raise UnknownOptionError("World.solver for mujoco", [world.solver], tuple(_SOLVERS))
        parts = read_parts(world)
        self._check_features(parts)
        log = mujoco.MjLogConfig.get()
        log.logto_file = log.logto_console = False
        log.set()
        self._world: WorldModel = ModelBuilder(parts).build()
        model = self._world.model
        _set_options(model, world)
        data = mujoco.MjData(model)
        self._running = Running(model, data, data.qpos.copy(), data.qvel.copy())
        self._bound: dict[int, tuple[Any, list[int], Vector]] = {}
        self._pictures: Pictures | None = None
        layout = layout_of(parts)
        robots = [
            MujocoRobot(movable, part, self._world.bodies[part.bodies], self._running)
            for movable, part in zip(parts.movables, layout.parts.values(), strict=True)
        ]
        self._contact_rows = ContactRows(self._world, data)
        self._drives = Drives(parts, layout, self._running, self._contact_rows.begin)
        self._touches = model.geom_contype.copy(), model.geom_conaffinity.copy()
        super().__init__(parts, robots, () if world.integrator == "euler" else RK4_LACKS)

    def _check_features(self, parts: Parts) -> None:
        world, features = parts.world, frozenset(FEATURES) - self.lacks
        if world.detector is not None:
            raise FeatureNotSupportedError(self.engine, f"detector {world.detector}", features)
        if world.integrator == "rk4":
            check_rk4(parts, self.engine, features)
        if parts.rolling:
            raise FeatureNotSupportedError(self.engine, "rolling", features)
        shapes = [shape for movable in parts.movables for shape in movable.model.shapes]
        if any(shape.restitution for shape in shapes):
            raise FeatureNotSupportedError(self.engine, "restitution", features)

    def make_algorithms(self) -> Algorithms:
        """Return MuJoCo's algorithms."""
        return MujocoAlgorithms(self.parts, self._world)

    def advance(self, n: int) -> None:
        """Simulate n physics steps.

        Raises:
            SimulationError: If MuJoCo cannot hold or solve the contacts of this world.
        """
        try:
            self._run(n)
        except mujoco.FatalError as error:
            raise SimulationError(f"MuJoCo cannot simulate this world: {error}") from error
        if any(self._running.data.warning[kind].number for kind in _FULL):
            raise SimulationError("MuJoCo's memory is too small for the contacts of this world.")

    def _run(self, n: int) -> None:
        running, data = self._running, self._running.data
        if self._drives.idle and not self._contact_rows.active:
            if n > 1:
                mujoco.mj_step(running.model, data, n - 1)
            running.positions[:], running.velocities[:] = data.qpos, data.qvel
            mujoco.mj_step(running.model, data)
            return
        for _ in range(n):
            if self._drives.idle:
                running.positions[:], running.velocities[:] = data.qpos, data.qvel
                self._contact_rows.step()
            else:
                self._drives.step()

    def change_gravity(self, gravity: tuple[float, ...]) -> None:
        """Change the gravity in MuJoCo."""
        self._running.model.opt.gravity[:] = gravity

    def change_parts(self, before: Parts) -> None:
        """Take over masses, friction, and ground."""
        self._world.write_masses(self.parts)
        if len(self._world.made):
            self._world.write_frictions(self.parts)
            self._contact_rows.note_frictions()
        if self.parts.world.ground is not before.world.ground:
            self._world.write_heights(self.parts)
            self._forget_pictures()
        self._derive()

    def hide(self, bodies: Sequence[int]) -> None:
        """Let only bodies that are not among these touch."""
        model, shown = self._running.model, ~np.isin(self._world.owners, bodies)
        model.geom_contype[:], model.geom_conaffinity[:] = (mask * shown for mask in self._touches)
        self._derive()

    def _derive(self) -> None:
        """Let MuJoCo derive what depends on changes; it then connects bodies as they began."""
        self._world.derive()
        self._write_bonds()

    def place_static(self, static: int, pose: Vector, velocity: Vector, surface: Vector) -> None:
        """Place a static body for the next step."""
        if len(self._world.statics):
            self._contact_rows.place(static, pose, velocity, surface)

    def bind(self, number: int, bond: Bond) -> None:
        """Hold two bodies together until `unbind`.

        Raises:
            SimulationError: If too many bodies are attached while it runs.
        """
        if len(self._bound) == len(self._world.spare):
            raise SimulationError(
                f"MuJoCo holds at most {len(self._world.spare)} attachments in this world; detach "
                "some, or build it with more of them."
            )
        kinds, frames = mujoco.mjtEq, bond.frames
        found = np.zeros(self._running.model.eq_data.shape[1])
        if bond.rigid:
            turn = frames[0][:3, :3] @ frames[1][:3, :3].T
            found[:3], found[3:6] = frames[1][:3, 3], frames[0][:3, 3]
            found[6:10], found[10] = quaternion_of(turn), 1.0
        else:
            found[:3], found[3:6] = frames[0][:3, 3], frames[1][:3, 3]
        bodies = [self._world.bodies[body] if body >= 0 else 0 for body in bond.bodies]
        kind = kinds.mjEQ_WELD if bond.rigid else kinds.mjEQ_CONNECT
        self._bound[number] = kind, bodies, found
        self._write_bonds()

    def unbind(self, number: int) -> None:
        """Stop holding two bodies together."""
        del self._bound[number]
        self._write_bonds()

    def _write_bonds(self) -> None:
        """Write what is held in the order of its numbers, which decides on the last digits."""
        model, data = self._running.model, self._running.data
        data.eq_active[self._world.spare] = False
        for place, each in zip(self._world.spare, self._bound.values(), strict=False):
            kind, bodies, found = each
            model.eq_obj1id[place], model.eq_obj2id[place] = bodies
            model.eq_type[place], model.eq_data[place] = kind, found
            data.eq_active[place] = True

    def clear_warm_start(self) -> None:
        """Make the state alone determine what follows."""
        self._running.data.qacc_warmstart[:] = 0.0
        self._contact_rows.expect_depth()

    def draw(
        self, camera: Camera, position: Vector, turn: Vector, passed: Sequence[int]
    ) -> dict[str, Vector]:
        """Return the images of a camera.

        Raises:
            SimulationError: If neither EGL nor OSMesa works here.
        """
        if self._pictures is None:
            self._pictures = Pictures(self._world)
        return self._pictures.take(self._running.data, camera, position, turn, passed)

    def _forget_pictures(self) -> None:
        if self._pictures is not None:
            self._pictures.close()
        self._pictures = None

    def read_contacts(self) -> Records:
        """Return the contacts of the last physics step."""
        model, data = self._running.model, self._running.data
        found, forces = np.zeros(data.ncon, CONTACT), np.zeros((data.ncon, 6))
        if not len(found):
            return found
        for number, force in enumerate(forces):
            mujoco.mj_contactForce(model, data, number, force)
        contact = data.contact
        frames = contact.frame.reshape(-1, 3, 3)
        owners = self._world.owners[contact.geom]
        # MuJoCo's force acts on the second body.
        sign = np.where(owners[:, 0] < owners[:, 1], -1.0, 1.0)[:, None]
        found["body_a"], found["body_b"] = owners.min(axis=1), owners.max(axis=1)
        found["point"], found["depth"] = contact.pos, -contact.dist
        found["normal"] = sign * frames[:, 0]
        found["force"] = sign * (forces[:, None, :3] @ frames)[:, 0]
        found["torque"] = sign * (forces[:, None, 3:] @ frames)[:, 0]
        return found

    def close(self) -> None:
        """Free the world; further calls do nothing."""
        if not self._closed:
            super().close()
            self._forget_pictures()
            del self._running, self._drives, self._contact_rows, self._world


def _set_options(model: mujoco.MjModel, world: World) -> None:
    option = model.opt
    option.timestep, option.gravity[:] = world.period, world.gravity
    kinds = mujoco.mjtIntegrator
    option.integrator = kinds.mjINT_RK4 if world.integrator == "rk4" else kinds.mjINT_DISCRETE
    option.solver = _SOLVERS[world.solver or "newton"]
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
    option.iterations = world.iterations or option.iterations
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SPECULATIVE
