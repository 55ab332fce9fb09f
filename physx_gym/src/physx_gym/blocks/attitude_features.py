"""Features that describe attitudes: their spaces and the names of their numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium import spaces

_COMPONENTS = {
    "orientation": "xyzw",
    "angular_velocity": "xyz",
    "roll_pitch_yaw": ("roll", "pitch", "yaw"),
}


def attitude_space(count: int, *, has_rpy: bool) -> spaces.Dict:
    """Return the space of attitudes; each feature has a column for each attitude.

    Args:
        count: Number of attitudes.
        has_rpy: Whether ``roll_pitch_yaw``, in rad, is a feature besides ``orientation``,
            quaternions x, y, z, w, and ``angular_velocity``, in rad/s.
    """
    limits = {"orientation": 1.01, "angular_velocity": np.inf, "roll_pitch_yaw": np.inf}
    return spaces.Dict(
        {
            name: spaces.Box(-most, most, (len(_COMPONENTS[name]), count), np.float64)
            for name, most in limits.items()
            if has_rpy or name != "roll_pitch_yaw"
        }
    )


def attitude_fieldnames(things: Sequence[str], *, has_rpy: bool) -> dict[str, list[list[str]]]:
    """Return the names of the features' numbers, given the names of the things with attitudes."""
    names = {
        name: [[f"{name}.{thing}.{part}" for thing in things] for part in _COMPONENTS[name]]
        for name in ("orientation", "angular_velocity")
    }
    if has_rpy:
        parts = _COMPONENTS["roll_pitch_yaw"]
        names["roll_pitch_yaw"] = [[f"{part}.{thing}" for thing in things] for part in parts]
    return names
