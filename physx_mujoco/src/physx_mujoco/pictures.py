"""Images of cameras, drawn by MuJoCo's offscreen renderer from the shapes of a world."""

from __future__ import annotations

import colorsys
import ctypes
import os
from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np

from physx_core import Closeable
from physx_core.typing import Vector
from physx_mujoco.model import WorldModel
from physx_sim import Camera
from physx_sim.errors import SimulationError

_LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
"""How MuJoCo draws without a display, and the library that it needs for it."""
_SLICES, _STACKS = 96, 48
"""Into how many facets round shapes are divided, around and along: errors of 0.05 % of a radius."""
_MORE = 100
"""Room for what a scene contains besides the shapes."""
_UNSEEN = 5
"""A group of shapes that MuJoCo does not draw."""
_GOLDEN = 0.618
"""Difference between the hues of consecutive bodies."""


class Pictures(Closeable):
    """Draws images of a world.

    Args:
        world: The world.

    Raises:
        SimulationError: If no library draws without a display.
    """

    def __init__(self, world: WorldModel) -> None:
        self._world, model = world, world.model
        self._context = _new_context()
        self._context.make_current()
        quality = model.vis.quality
        quality.offsamples, quality.numslices, quality.numstacks = 0, _SLICES, _STACKS
        model.stat.extent = 1.0
        for owner in set(world.owners.tolist()):
            shade = colorsys.hsv_to_rgb(owner * _GOLDEN % 1.0, 0.4, 0.9)
            model.geom_rgba[world.owners == owner, :3] = shade
        self._target = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        self._target.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._target)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + _MORE)
        self._data = mujoco.MjData(model)

    def take(
        self,
        data: Any,
        camera: Camera,
        position: Vector,
        turn: Vector,
        passed: Collection[int],
    ) -> dict[str, Vector]:
        """Return the images of a camera by their names.

        Args:
            data: The state of the world.
            camera: The camera.
            position: Its position in the world, shape (3,), in m.
            turn: Its axes in the world, as columns, shape (3, 3).
            passed: Bodies that it does not see.
        """
        self._context.make_current()
        self._place(data, camera, position, turn, passed)
        found: dict[str, Vector] = {}
        if {"depth", "segmentation"} & set(camera.images):
            colors, depth = self._draw(camera, by_number=True)
            near, far = camera.near, camera.reach
            found["depth"] = near * far / (near + depth * (far - near))
            found["segmentation"] = self._bodies()[colors @ (1, 1 << 8, 1 << 16)]
        if "rgb" in camera.images:
            found["rgb"] = self._draw(camera, by_number=False)[0].astype(np.float64)
        return {name: found[name] for name in camera.images}

    def _place(
        self,
        data: Any,
        camera: Camera,
        position: Vector,
        turn: Vector,
        passed: Collection[int],
    ) -> None:
        """Fill the scene with what the camera may see, and place the camera."""
        model, still = self._world.model, self._data
        still.qpos[:] = data.qpos
        still.mocap_pos[:], still.mocap_quat[:] = data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(model, still)
        model.geom_group[:] = np.where(np.isin(self._world.owners, list(passed)), _UNSEEN, 0)
        model.vis.map.znear, model.vis.map.zfar = camera.near, camera.reach
        view, option = mujoco.MjvCamera(), mujoco.MjvOption()
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, still, option, None, view, every, self._scene)
        top = camera.near * np.tan(0.5 * camera.field_of_view)
        for eye in self._scene.camera:
            eye.pos, eye.forward, eye.up = position, turn[:, 0], turn[:, 2]
            eye.frustum_near, eye.frustum_far = camera.near, camera.reach
            eye.frustum_bottom, eye.frustum_top = -top, top
            eye.frustum_center = eye.frustum_width = 0.0  # the width follows from the image's

    def _draw(self, camera: Camera, *, by_number: bool) -> tuple[Any, Vector]:
        """Return colors, shape (height, width, 3), and the depth buffer, from the top down."""
        flags, kinds = self._scene.flags, mujoco.mjtRndFlag
        flags[kinds.mjRND_SEGMENT] = flags[kinds.mjRND_IDCOLOR] = by_number
        target, size = self._target, (camera.height, camera.width)
        if target.offWidth < camera.width or target.offHeight < camera.height:
            wide, high = max(target.offWidth, size[1]), max(target.offHeight, size[0])
            mujoco.mjr_resizeOffscreen(wide, high, target)
        frame = mujoco.MjrRect(0, 0, camera.width, camera.height)
        mujoco.mjr_render(frame, self._scene, target)
        colors, depth = np.empty((*size, 3), np.uint8), np.empty(size, np.float32)
        mujoco.mjr_readPixels(colors, depth, frame, target)
        return colors[::-1], depth[::-1].astype(np.float64)

    def _bodies(self) -> Vector:
        """Return the body for each number that is drawn in the place of a color; -1: none."""
        shapes = self._scene.geoms[: self._scene.ngeom]
        found = np.full(len(shapes) + 1, -1.0)
        for shape in shapes:
            if shape.segid >= 0 and shape.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                found[shape.segid + 1] = self._world.owners[shape.objid]
        return found

    def close(self) -> None:
        """Free the graphics memory; further calls do nothing."""
        if self._target is not None:
            self._context.make_current()
            self._target.free()
            self._context.free()
            self._target = None


def _new_context() -> Any:
    """Return a context for drawing without a display."""
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    reasons = []
    for name in [wanted] if wanted in _LIBRARIES else _LIBRARIES:
        try:
            ctypes.CDLL(_LIBRARIES[name])
            if name == "egl":
                from mujoco.egl import GLContext  # loads the library
            else:
                from mujoco.osmesa import GLContext
            return GLContext(1, 1)
        except Exception as error:  # each library fails in its own way
            reasons.append(f"{name}: {error}")
    raise SimulationError(
        f"Cameras are drawn with EGL or OSMesa, and neither works here ({'; '.join(reasons)}). "
        "Install one of them: apt-get install libegl1 libgl1-mesa-dri, or apt-get install "
        "libosmesa6."
    )
