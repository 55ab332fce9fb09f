"""Names of the features that a simulation may have."""

from __future__ import annotations

FEATURES = {
    "accelerations": "accelerations of the last step",
    "actuators": "joint modes servo, velocity and position",
    "armature": "JointSettings.armature",
    "attachments": "Weld and Connect, in the world from the start or while it runs",
    "body_contacts": "contacts between moving bodies",
    "cameras": "images of cameras: depth, segmentation, colors",
    "changes": "masses, friction, hidden objects and height fields that change while it runs",
    "contacts": "contacts with static bodies",
    "couplings": "joints whose positions have a constant sum: differentials, locked joints",
    "derivatives": "derivatives of the forward dynamics",
    "exact_restore": "bit-identical continuation after restore",
    "forward_dynamics": "forward dynamics of any state",
    "gravity": "gravity that changes while it runs",
    "hooks": "functions called before physics steps",
    "inverse_dynamics": "inverse dynamics of any state",
    "isotropic_friction": "friction that is the same in all directions (a cone)",
    "jacobian": "Jacobians of links",
    "joint_friction": "Coulomb friction in joints",
    "joint_wrenches": "reactions of joints on their child links, at their origins, in their frames",
    "limits": "position and velocity limits of joints",
    "mass_matrix": "mass matrix of any state",
    "mesh_contacts": "meshes as collision shapes",
    "moving_statics": "static bodies that move as prescribed, and surfaces that move like belts",
    "raycast": "ray casts",
    "restitution": "bouncing contacts",
    "mimic": "joints that follow others",
    "rk4": 'World(integrator="rk4")',
    "self_collisions": "Robot(self_collisions=True)",
    "springs": "springs and damping in joints",
    "step_derivatives": "derivatives of steps, through contacts, limits and motors",
    "torsional_friction": "torsional and rolling friction of contacts",
    "wrenches": "external forces",
}
"""Every feature that a simulation may have, with its meaning."""
