# SPDX-License-Identifier: MIT
"""True optical flow and occlusion between two frames, from depth, poses and the motion of the bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ajna.sim.camera import Frame

__all__ = ["occlusion_and_flow", "warp"]

_DEPTH_TOLERANCE = 0.01  # of the depth, and metres


def occlusion_and_flow(first: Frame, second: Frame) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """What moved where.

    Each pixel's point in the world is carried along with the body it lies on and projected into the second frame;
    the sky lies at infinity and only turns.

    Returns:
        occlusion bool [H, W]: the point is hidden in the second frame, or outside of it;
        flow float32 [H, W, 2] in pixels on the first frame's grid: first(x) ~ second(x + flow(x)).
    """
    camera = first.camera
    pose1, position1, rotation1 = first.poses
    pose2, position2, rotation2 = second.poses
    sky = ~np.isfinite(first.depth)
    body = np.where(sky, 0, first.body)

    # Motion of each body between the frames: p2 = turn p1 + shift.
    turn = rotation2 @ rotation1.transpose(0, 2, 1)
    shift = position2 - np.einsum("bij,bj->bi", turn, position1)
    depth = np.where(sky, 1.0, first.depth).astype(np.float64)
    direction = camera.rays @ pose1[:3, :3].T
    points = depth[..., None] * direction + pose1[:3, 3]
    for number in np.unique(body):
        if number > 0:  # body 0 is the world
            on_body = body == number
            points[on_body] = points[on_body] @ turn[number].T + shift[number]
    # x_camera2 = R2^T (x - t2); a direction at infinity only turns.
    seen = np.where(sky[..., None], direction, points - pose2[:3, 3]) @ pose2[:3, :3]
    pixels, z = camera.project(seen)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    flow = pixels - np.stack([columns, rows], axis=-1)

    x, y = pixels[..., 0], pixels[..., 1]
    inside = (x >= 0) & (y >= 0) & (x <= camera.width - 1) & (y <= camera.height - 1)  # False for NaN
    left = np.where(inside, np.floor(x), 0).astype(np.intp)
    top = np.where(inside, np.floor(y), 0).astype(np.intp)
    right, bottom = np.minimum(left + 1, camera.width - 1), np.minimum(top + 1, camera.height - 1)
    around = np.stack([second.depth[r, c] for r in (top, bottom) for c in (left, right)])
    farthest = around.max(axis=0)
    hidden = np.where(sky, np.isfinite(farthest), z > farthest * (1 + _DEPTH_TOLERANCE) + _DEPTH_TOLERANCE)
    return ~inside | hidden, flow.astype(np.float32)


def warp(second: NDArray[np.uint8], flow: NDArray[np.float32]) -> NDArray[np.float32]:
    """The second frame pulled back onto the first one's grid, float32 [H, W, 3]; bilinear, at borders the border."""
    height, width = flow.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    x = np.clip(np.nan_to_num(columns + flow[..., 0]), 0, width - 1)
    y = np.clip(np.nan_to_num(rows + flow[..., 1]), 0, height - 1)
    left, top = np.minimum(np.floor(x), width - 2).astype(int), np.minimum(np.floor(y), height - 2).astype(int)
    a, b = (x - left)[..., None], (y - top)[..., None]
    upper = (1 - a) * second[top, left] + a * second[top, left + 1]
    lower = (1 - a) * second[top + 1, left] + a * second[top + 1, left + 1]
    return ((1 - b) * upper + b * lower).astype(np.float32)
