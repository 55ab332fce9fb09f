"""Values that rewards, terminations and observers share, computed at most once a step."""

from __future__ import annotations

from physx_gym.tasks.quantities.bodies import (
    BaseHeight,
    BaseVelocity,
    BodyOrientations,
    BodyPoses,
    BodyPositions,
    BodyVelocities,
    MeanBodyVelocities,
    MeanOdometry,
    MeanPose,
    Odometry,
    OdometryVelocity,
    RelativePoses,
    RollPitch,
)
from physx_gym.tasks.quantities.combined import (
    Computed,
    Delta,
    Joined,
    Masked,
    Mean,
    Rate,
    Stacked,
)
from physx_gym.tasks.quantities.contacts import (
    ContactForces,
    HighestContactForce,
    SlipVelocity,
    Touching,
    VerticalForceShares,
)
from physx_gym.tasks.quantities.dynamics import (
    CapturePoint,
    CenterOfMass,
    CenterOfMassVelocity,
    MechanicalPower,
    Momentum,
    ZeroMomentPoint,
)
from physx_gym.tasks.quantities.geometry import (
    angle_difference,
    odometry_difference,
    orientation_difference,
    pose_difference,
)
from physx_gym.tasks.quantities.joints import (
    JointPositions,
    JointTorques,
    JointVelocities,
    LimitDistances,
)
from physx_gym.tasks.quantities.quantity import (
    Moment,
    Quantities,
    Quantity,
    Reference,
    Remembering,
)

__all__ = [
    "BaseHeight",
    "BaseVelocity",
    "BodyOrientations",
    "BodyPoses",
    "BodyPositions",
    "BodyVelocities",
    "CapturePoint",
    "CenterOfMass",
    "CenterOfMassVelocity",
    "Computed",
    "ContactForces",
    "Delta",
    "HighestContactForce",
    "Joined",
    "JointPositions",
    "JointTorques",
    "JointVelocities",
    "LimitDistances",
    "Masked",
    "Mean",
    "MeanBodyVelocities",
    "MeanOdometry",
    "MeanPose",
    "MechanicalPower",
    "Moment",
    "Momentum",
    "Odometry",
    "OdometryVelocity",
    "Quantities",
    "Quantity",
    "Rate",
    "Reference",
    "RelativePoses",
    "Remembering",
    "RollPitch",
    "SlipVelocity",
    "Stacked",
    "Touching",
    "VerticalForceShares",
    "ZeroMomentPoint",
    "angle_difference",
    "odometry_difference",
    "orientation_difference",
    "pose_difference",
]
