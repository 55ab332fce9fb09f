"""What a simulation may be able to do, by the names that its `features` have."""

from __future__ import annotations

FEATURES = {
    "accelerations": "accelerations of the last step",
    "actuators": "joint modes servo, velocity and position",
    "armature": "JointSettings.armature",
    "body_contacts": "contacts between things that both move",
    "contacts": "contacts with what does not move",
    "derivatives": "derivatives of the forward dynamics",
    "exact_restore": "restore goes on bit for bit",
    "forward_dynamics": "forward dynamics of any state",
    "hooks": "functions called at physics steps",
    "inverse_dynamics": "inverse dynamics of any state",
    "isotropic_friction": "friction that is the same in all directions",
    "jacobian": "Jacobians of links",
    "joint_friction": "Coulomb friction in joints",
    "joint_wrenches": "what joints carry, on the link behind: at its origin, along its axes",
    "limits": "limits of joints' positions and velocities stop them",
    "mass_matrix": "mass matrix of any state",
    "mesh_contacts": "meshes as collision shapes",
    "raycast": "rays",
    "restitution": "things bounce",
    "rk4": 'World(integrator="rk4")',
    "self_collisions": "Robot(self_collisions=True)",
    "springs": "springs and damping in joints",
    "wrenches": "forces from outside",
}
"""Every feature that a simulation's `features` may name, and what it means."""
