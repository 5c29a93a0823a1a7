# SPDX-License-Identifier: MIT
"""Images, flow files and video, read strictly and written atomically (C++ on OpenCV; the GIL is released).

Images are RGB uint8 [H, W, 3]; flow is float32 [H, W, 2] in pixels, u to the right, v down. Whatever is not a whole
file of its format raises one clear ``ValueError``; a missing file or folder ``FileNotFoundError``; a machine that
refuses (disk full, unwritable folder, lost camera) ``RuntimeError``. A file appears under its name only when complete.
"""

from __future__ import annotations

from ajna import _core

if not _core.with_vision:
    raise ImportError(
        "this build of ajna has no vision support (AJNA_WITH_VISION=OFF): install OpenCV and build again with it ON",
        name="ajna.io",
    )

Frame = _core.Frame
VideoSource = _core.VideoSource
VideoWriter = _core.VideoWriter
known_flow = _core.known_flow
read_flo = _core.read_flo
read_image = _core.read_image
read_kitti_flow = _core.read_kitti_flow
read_pfm = _core.read_pfm
write_flo = _core.write_flo
write_image = _core.write_image
write_kitti_flow = _core.write_kitti_flow
write_pfm = _core.write_pfm

__all__ = [
    "Frame",
    "VideoSource",
    "VideoWriter",
    "known_flow",
    "read_flo",
    "read_image",
    "read_kitti_flow",
    "read_pfm",
    "write_flo",
    "write_image",
    "write_kitti_flow",
    "write_pfm",
]
