# SPDX-License-Identifier: MIT
"""Pictures, depth and segmentation of a MuJoCo model, from the camera on its vehicle."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ajna.sim.camera import CameraModel
from ajna.sim.gl import make_context

__all__ = ["CAMERA", "COLLISION_GROUP", "FAR_M", "NEAR_M", "VEHICLE_GROUP", "Renderer", "rendering_settings"]

CAMERA = "camera"  # the name of the vehicle's camera in every model
VEHICLE_GROUP = 2  # geoms that the vehicle's own camera does not see
COLLISION_GROUP = 3  # geoms that nobody sees
NEAR_M, FAR_M = 0.03, 150.0
_MAX_OUTSIDE = (640, 480)  # pictures from outside, for videos

# From OpenGL's camera (x right, y up, z backward) to the optical frame (x right, y down, z forward).
_OPTICAL = np.diag([1.0, -1.0, -1.0])


def rendering_settings(spec: Any) -> None:
    """Clip planes, buffer size, and light that stays with the world: what makes true flow hold in the picture."""
    spec.stat.extent = 1.0  # clip planes below are then in metres
    spec.visual.map.znear, spec.visual.map.zfar = NEAR_M, FAR_M
    spec.visual.quality.offsamples = 0  # averaging of a larger picture is the anti-aliasing
    spec.visual.quality.shadowsize = 0
    spec.visual.headlight.active = 0  # a light on the camera would change the brightness of what it passes
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960


class Renderer:
    """Renders one model. Holds an OpenGL context: use in one thread, and :meth:`close` it.

    Raises:
        NoRenderingError: there is no way to render here.
    """

    def __init__(self, model: Any, camera: CameraModel) -> None:
        self.model = model
        self.camera = camera
        self._data = mujoco.MjData(model)
        self._camera_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, CAMERA)
        self._camera_position = np.array(model.cam_pos[self._camera_id])
        model.cam_fovy[self._camera_id] = np.rad2deg(camera.vertical_fov_rad)
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = self._camera_id
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[0] = 1
        self._outside_option = mujoco.MjvOption()
        self._outside_option.geomgroup[:] = 0
        self._outside_option.geomgroup[[0, VEHICLE_GROUP]] = 1
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 64)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = 0
        scale = camera.render_scale
        self._gl: Any = make_context(
            max(camera.width * scale, _MAX_OUTSIDE[0]), max(camera.height * scale, _MAX_OUTSIDE[1])
        )
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._geom_of_segment: NDArray[np.int32] | None = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL context; the renderer cannot be used afterwards."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None

    def _set(self, qpos: NDArray[np.float64], offset_right_m: float = 0.0) -> None:
        if self._gl is None:
            raise RuntimeError("this renderer is closed; make a new one")
        # The camera looks along the body's x axis: right is its negative y axis (through the mounting rotation).
        orientation = np.empty(9)
        mujoco.mju_quat2Mat(orientation, self.model.cam_quat[self._camera_id])
        right = orientation.reshape(3, 3)[:, 0]
        self.model.cam_pos[self._camera_id] = self._camera_position + offset_right_m * right
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)

    def poses(self, qpos: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """T_world_camera [4, 4] (optical frame), body positions [B, 3] and rotations [B, 3, 3] at ``qpos``."""
        self._set(qpos)
        transform = np.eye(4)
        transform[:3, :3] = self._data.cam_xmat[self._camera_id].reshape(3, 3) @ _OPTICAL
        transform[:3, 3] = self._data.cam_xpos[self._camera_id]
        return transform, self._data.xpos.copy(), self._data.xmat.reshape(-1, 3, 3).copy()

    def _draw(self, view: Any, option: Any, rect: Any) -> None:
        self._gl.make_current()
        mujoco.mjv_updateScene(self.model, self._data, option, None, view, mujoco.mjtCatBit.mjCAT_ALL, self._scene)
        mujoco.mjr_render(rect, self._scene, self._context)

    def color(self, qpos: NDArray[np.float64], offset_right_m: float = 0.0) -> NDArray[np.float32]:
        """The picture at an instant, grey levels float32 [H, W, 3], averaged from the larger rendered one."""
        scale, width, height = self.camera.render_scale, self.camera.width, self.camera.height
        rect = mujoco.MjrRect(0, 0, width * scale, height * scale)
        self._set(qpos, offset_right_m)
        self._draw(self._view, self._option, rect)
        large = np.empty((height * scale, width * scale, 3), np.uint8)
        mujoco.mjr_readPixels(large, None, rect, self._context)
        # Sums of slices: several times as fast as sums over an axis, and this runs for every picture.
        rows = large[::scale].astype(np.uint16)
        for offset in range(1, scale):
            rows += large[offset::scale]
        cells = rows.reshape(height, width, 3 * scale)
        total = cells[..., :3].copy()
        for offset in range(1, scale):
            total += cells[..., 3 * offset : 3 * offset + 3]
        return total[::-1].astype(np.float32) / np.float32(scale * scale)

    def depth_and_geom(self, qpos: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Depth in metres float32 [H, W] (infinite in the sky) and the geom's number int32 [H, W] (-1 in the sky)."""
        width, height = self.camera.width, self.camera.height
        rect = mujoco.MjrRect(0, 0, width, height)
        self._set(qpos)
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        try:
            self._draw(self._view, self._option, rect)
        finally:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 0
        code = np.empty((height, width, 3), np.uint8)
        buffer = np.empty((height, width), np.float32)
        mujoco.mjr_readPixels(code, buffer, rect, self._context)
        segment = code[..., 0] + 256 * code[..., 1].astype(np.int32) + 65536 * code[..., 2].astype(np.int32)
        geom = self._segment_table()[segment[::-1]]
        # Depth buffer 0 at the far plane, 1 at the near one, hyperbolic between.
        b = buffer[::-1].astype(np.float64)
        with np.errstate(divide="ignore"):
            depth = NEAR_M * FAR_M / (NEAR_M + b * (FAR_M - NEAR_M))
        return np.where(geom < 0, np.inf, depth).astype(np.float32), geom

    def _segment_table(self) -> NDArray[np.int32]:
        """From the number in the segmentation picture to the geom's; the order of the scene is fixed per model."""
        if self._geom_of_segment is None:
            table = np.full(self.model.ngeom + 66, -1, np.int32)
            for geom in self._scene.geoms[: self._scene.ngeom]:
                if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.segid >= 0:
                    table[geom.segid + 1] = geom.objid
            self._geom_of_segment = table
        return self._geom_of_segment

    def outside(
        self,
        qpos: NDArray[np.float64],
        lookat: NDArray[np.float64],
        distance_m: float,
        azimuth_deg: float,
        elevation_deg: float,
        size: tuple[int, int] = (320, 240),
    ) -> NDArray[np.uint8]:
        """A picture from outside that shows the vehicle too, RGB uint8 [height, width, 3]; size at most 640x480."""
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FREE
        view.lookat[:] = lookat
        view.distance, view.azimuth, view.elevation = distance_m, azimuth_deg, elevation_deg
        self._set(qpos)
        rect = mujoco.MjrRect(0, 0, *size)
        self._draw(view, self._outside_option, rect)
        picture = np.empty((size[1], size[0], 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, rect, self._context)
        return picture[::-1].copy()
