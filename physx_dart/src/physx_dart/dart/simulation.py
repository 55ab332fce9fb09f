"""The engine DART. All calls to dartpy are in `physx_dart.dart`.

DART integrates with semi-implicit Euler: velocities first, then positions with the new velocities;
the integrator ``rk4`` only uses its forward dynamics. Damping and springs are implicit; contacts,
position and velocity limits, servos, and Coulomb friction are constraints of its solver.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import dartpy
import numpy as np
from dartpy import constraint
from dartpy.simulation import CollisionDetectorType

from physx_core.errors import UnknownOptionError, listed
from physx_core.rotations import to_matrix
from physx_core.typing import Records, Vector
from physx_dart.dart.bonds import bonded
from physx_dart.dart.contacts import ContactReader
from physx_dart.dart.loading import (
    attach_shapes,
    attach_static,
    place_skeleton,
    static_skeleton,
)
from physx_dart.dart.skeleton import DartRobot
from physx_sim import FEATURES, HeightField, Simulation, World
from physx_sim.engines import (
    RK4_LACKS,
    Algorithms,
    Bond,
    CollisionShape,
    Parts,
    RobotBackend,
    RobotSimulation,
    check_rk4,
    read_parts,
    warn_once,
)
from physx_sim.errors import FeatureNotSupportedError

_DETECTORS = {
    "dart": CollisionDetectorType.DART,
    "fcl": CollisionDetectorType.FCL,
    "bullet": CollisionDetectorType.BULLET,
    "ode": CollisionDetectorType.ODE,
}
_SOLVERS = ("nsgs", "fbf", "dantzig")
_ISOTROPIC = ("nsgs", "fbf")
_STATELESS = ("dart", "dantzig")
"""The detector and the solver that keep nothing between steps. With an iterative solver, impulses
kept by this detector depend on memory addresses, so even a rerun differs."""
_HEAVY = 20
"""Ratio of masses above which the iterative solvers let a body sink into one below it."""
_CORRECTED = "what contacts, limits and servos change is corrected in the next step"
"""What the table of features says about couplings of joints."""
_SWEEPS, _TOLERANCE = 50, 1e-6
"""Maximum iterations of ``nsgs`` per step, and the error in m/s that ends them. They start from
the impulses of the last step, so more iterations mostly sharpen impacts (docs/contacts.md)."""


class DartBackend(RobotBackend):
    """DART, a simulator of articulated bodies.

    Contact solvers: ``nsgs`` (default) and ``fbf``, iterative with Coulomb's law; ``dantzig``, a
    direct solver whose friction is up to 41 % too strong between the axes, and too weak where it
    holds parts together (docs/contacts.md). Without contacts the default is ``dantzig``, which is
    then exact. Detectors: ``bullet`` (default), ``ode`` (default on height fields), ``fcl``
    (without capsules), and ``dart`` (default for ``dantzig``), with which the other solvers are not
    bit-reproducible.
    """

    def build(self, world: World, seed: int | None = None) -> Simulation:
        """Build a simulation; DART is deterministic, so the seed has no effect.

        Raises:
            ModelError: If a robot or mesh cannot be loaded; the message gives the reason.
            FeatureNotSupportedError: If the world needs a feature that DART does not have.
            UnknownOptionError: If there is no detector or solver with that name.
        """
        return DartSimulation(world)


class DartSimulation(RobotSimulation[DartRobot]):
    """A world in DART."""

    engine = "dart"
    lacks: ClassVar[frozenset[str]] = frozenset(
        {"cameras", "rolling", "step_derivatives", "torsional_friction"}
    )
    caveats: ClassVar[Mapping[str, str]] = {
        "armature": "impulses of contacts, limits and servos do not know it: a warning",
        "couplings": _CORRECTED,
        "exact_restore": "not with the detector `dart` and an iterative solver",
        "isotropic_friction": "not with the solver `dantzig`",
        "joint_wrenches": "not while anything is attached",
        "moving_statics": "a surface that moves along itself pushes what touches its ends",
        "mimic": _CORRECTED,
    }

    def __init__(self, world: World) -> None:
        """Build the world; raises the same errors as the backend's `build`."""
        for option, name, known in (
            ("detector", world.detector, tuple(_DETECTORS)),
            ("solver", world.solver, _SOLVERS),
        ):
            if name is not None and name not in known:
                raise UnknownOptionError(f"World.{option} for dart", [name], known)
        parts = read_parts(world)
        _warn_of_rotors(parts)
        touching = any(movable.model.shapes for movable in parts.movables)
        solver = world.solver or ("nsgs" if touching else "dantzig")
        detector = world.detector or _detector(world, solver)
        if solver in _ISOTROPIC and world.contacts == "all":
            _warn_of_ratios(parts)
        self._check_features(parts, detector)
        self._world = _new_world(world, detector, solver)
        self._stateless = (detector, solver) == _STATELESS
        self._kept: Records | None = None
        self._rk4 = world.integrator == "rk4"
        robots = [self._add(parts, place) for place in range(len(parts.movables))]
        statics = [] if world.contacts == "none" else parts.statics
        self._prepared = [robot for robot in robots if robot.prepares]
        self._statics = [static_skeleton(static) for static in statics]
        for skeleton in self._statics:
            self._world.addSkeleton(skeleton)
        bodies = [body for robot in robots for body in robot.bodies]
        bodies += [skeleton.getBodyNode(0) for skeleton in self._statics]
        self._nodes, self._bonds = bodies, dict[int, tuple[Bond, Any]]()
        immobile = [[body] for body in bodies[len(bodies) - len(self._statics) :]]
        immobile += [robot.bodies for robot in robots if not robot.movable.moves]
        _disable_contacts(self._world, immobile)
        if world.contacts == "static":
            _disable_contacts(
                self._world, [robot.bodies for robot in robots if robot.movable.moves]
            )
        self._reader = ContactReader(self._world, bodies, world.period)
        self._step_world = self._world.step
        lacks = [] if solver in _ISOTROPIC else ["isotropic_friction"]
        lacks += ["exact_restore"] if detector == "dart" and not self._stateless else []
        lacks += RK4_LACKS if self._rk4 else []
        super().__init__(parts, robots, lacks)

    def _check_features(self, parts: Parts, detector: str) -> None:
        features = frozenset(FEATURES) - self.lacks
        if parts.world.integrator == "rk4":
            check_rk4(parts, self.engine, features)
        if parts.rolling:
            raise FeatureNotSupportedError(self.engine, "rolling", features)
        shapes = [shape for each in parts.movables for shape in each.model.shapes]
        if parts.turning and parts.world.contacts != "none":
            advice = "Robot(torsional_friction=0.0, rolling_friction=0.0) leaves out a file's."
            raise FeatureNotSupportedError(self.engine, "torsional_friction", features, advice)
        shapes += [each.what for each in parts.statics if isinstance(each.what, CollisionShape)]
        if detector == "fcl" and any(shape.kind == "capsule" for shape in shapes):
            advice = "Use another detector."
            raise FeatureNotSupportedError(self.engine, "capsules in fcl", features, advice)

    def _add(self, parts: Parts, place: int) -> DartRobot:
        movable = parts.movables[place]
        robot = DartRobot(movable, parts.world)
        if parts.world.contacts != "none":
            attach_shapes(robot.skeleton, movable)
        if movable.self_collisions and movable.moves and parts.world.contacts == "all":
            robot.skeleton.enableSelfCollisionCheck()
        self._world.addSkeleton(robot.skeleton)
        return robot

    def make_algorithms(self) -> Algorithms:
        """Return Pinocchio's algorithms."""
        from physx_dart.batch.processes import ParallelAlgorithms  # its library loads slowly

        return ParallelAlgorithms.of_parts(self.parts)

    def advance(self, n: int) -> None:
        """Simulate n physics steps."""
        if self._rk4:
            for robot in self._robots:
                robot.run_rk4(n, self.period)
            return
        self._kept, step = None, self._step_world
        for _ in range(n):
            for robot in self._prepared:
                robot.prepare()
            step(False)

    def change_gravity(self, gravity: tuple[float, ...]) -> None:
        """Change the gravity in DART."""
        self._world.setGravity(list(gravity))
        for robot in self._robots:
            robot.change_gravity(gravity)

    def change_parts(self, before: Parts) -> None:
        """Take over masses, friction, and ground."""
        self._keep_contacts()
        for robot, old, new in zip(self._robots, before.movables, self.parts.movables, strict=True):
            if new is not old:
                robot.change(new)
        for skeleton, was, static in zip(
            self._statics, before.statics, self.parts.statics, strict=False
        ):
            if static is not was:
                attach_static(skeleton.getBodyNode(0), static)

    def hide(self, bodies: Sequence[int]) -> None:
        """Let only bodies that are not among these touch."""
        for place, node in enumerate(self._nodes):
            node.setCollidable(place not in bodies)

    def place_static(self, static: int, pose: Vector, velocity: Vector, surface: Vector) -> None:
        """Place a static body for the next step."""
        if self._statics:
            moved = velocity.copy()
            moved[:3] += to_matrix(pose[3:]) @ surface
            place_skeleton(self._statics[static], pose, moved)

    def bind(self, number: int, bond: Bond) -> None:
        """Hold two bodies together until `unbind`."""
        nodes = [self._nodes[body] if body >= 0 else None for body in bond.bodies]
        held = bonded(nodes, bond)
        self._bonds[number] = bond, held
        self._world.getConstraintSolver().addConstraint(held)

    def unbind(self, number: int) -> None:
        """Stop holding two bodies together."""
        self._world.getConstraintSolver().removeConstraint(self._bonds.pop(number)[1])

    def clear_warm_start(self) -> None:
        """Make the state alone determine what follows.

        Iterative solvers start from the impulses of the last step, and some detectors from its
        contacts. DART keeps them as long as its solver holds the same skeletons. So do constraints
        between bodies.
        """
        for robot in self._robots:
            robot.clear_warm_start()
        for number, (bond, _) in list(self._bonds.items()):
            self.unbind(number)
            self.bind(number, bond)
        if self._stateless:
            return
        self._keep_contacts()
        contacts = self._world.getConstraintSolver()
        contacts.removeAllSkeletons()
        for skeleton in [*(robot.skeleton for robot in self._robots), *self._statics]:
            contacts.addSkeleton(skeleton)

    def _keep_contacts(self) -> None:
        """Keep the contacts of the last step, as what touched in DART is about to be replaced."""
        if self._stepped:
            self._kept = self.read_contacts()
        self._reader.clear_warm_start()

    def read_contacts(self) -> Records:
        """Return the contacts of the last physics step."""
        return self._reader.contacts() if self._kept is None else self._kept.copy()

    def forward_dynamics(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations, shape (nv,), caused by torques (nv,), computed by DART."""
        q, v, tau = self._checked_state(positions, velocities, torques=torques)
        return np.concatenate([x.forward(q[i], v[j], tau[j]) for x, i, j in self._slices])

    def inverse_dynamics(
        self, positions: Vector, velocities: Vector, accelerations: Vector
    ) -> Vector:
        """Return the torques, shape (nv,), that produce accelerations (nv,), computed by DART."""
        q, v, a = self._checked_state(positions, velocities, accelerations=accelerations)
        return np.concatenate([x.inverse(q[i], v[j], a[j]) for x, i, j in self._slices])

    def close(self) -> None:
        """Free the world; further calls do nothing."""
        if not self._closed:
            super().close()
            del self._step_world, self._reader, self._statics, self._world
            del self._nodes, self._bonds, self._prepared


def _detector(world: World, solver: str) -> str:
    """Return the default detector: of all, only ``ode`` holds boxes on height fields."""
    if isinstance(world.ground, HeightField):
        return "ode"
    return "dart" if solver == "dantzig" else "bullet"


def _warn_of_ratios(parts: Parts) -> None:
    """Warn once of bodies that are so much heavier than others that these do not hold them."""
    masses = {
        movable.name: sum(body.mass for body in movable.model.bodies)
        for movable in parts.movables
        if not movable.fixed_base and movable.model.shapes
    }
    if not masses:
        return
    light, heavy = min(masses, key=masses.__getitem__), max(masses, key=masses.__getitem__)
    if masses[heavy] > _HEAVY * masses[light]:
        warn_once(
            f'"{heavy}" is {masses[heavy] / masses[light]:.0f} times as heavy as "{light}". Where '
            "it stands on it, it sinks in on DART's default solver. "
            'World(solver="dantzig") holds it, with friction that depends on the direction; so do '
            "the engines pinocchio and mujoco."
        )


def _warn_of_rotors(parts: Parts) -> None:
    """Warn once for each robot whose rotors DART's impulses do not know."""
    for movable in parts.movables:
        names = [joint.name for joint in movable.model.joints if joint.armature]
        if names:
            warn_once(
                f'Robot "{movable.name}", {movable.model.path}: in DART, impulses of contacts, '
                f"limits and servos do not know the armature of the joints {listed(names)}: the "
                "more of their inertia it is, the weaker they are."
            )


def _new_world(world: World, detector: str, solver: str) -> Any:
    made = dartpy.simulation.World()
    made.setTimeStep(world.period)
    made.setGravity(list(world.gravity))
    made.setCollisionDetector(_DETECTORS[detector])
    sleeping = made.getDeactivationOptions()
    sleeping.mEnabled = False
    made.setDeactivationOptions(sleeping)
    contacts = made.getConstraintSolver()
    if solver == "nsgs":
        options = constraint.NsgsFrictionSolver.Options()
        options.maxSweeps, options.tolerance = world.iterations or _SWEEPS, _TOLERANCE
        contacts.setBoxedLcpSolver(constraint.NsgsFrictionSolver(options))
    elif solver == "fbf":
        options = constraint.FbfFrictionSolver.Options()
        options.maxOuterIterations = world.iterations or options.maxOuterIterations
        contacts.setBoxedLcpSolver(constraint.FbfFrictionSolver(options))
    return made


def _disable_contacts(world: Any, groups: list[list[Any]]) -> None:
    """Disable contacts between bodies in different groups."""
    collisions = world.getConstraintSolver().getCollisionOption().collisionFilter
    solid = [[body for body in bodies if body.getNumShapeNodes()] for bodies in groups]
    for place, bodies in enumerate(solid):
        for others in solid[place + 1 :]:
            for body in bodies:
                for other in others:
                    collisions.addBodyNodePairToBlackList(body, other)
