# SPDX-License-Identifier: MIT
"""Small valid inputs for the fuzzers to begin with, one folder per harness: python tests/fuzz/seeds.py build/fuzz/seeds

    build/fuzz/tests/fuzz/fuzz_image -max_total_time=600 -max_len=65536 build/fuzz/seeds/image

Needs the installed package.
"""

from __future__ import annotations

import struct
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from ajna import io, nn
from ajna.losses import UncertaintyLoss

ROOT = Path(__file__).resolve().parents[2]


def put(folder: Path, name: str, data: bytes) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(data)


def images(out: Path, scratch: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8)
    for suffix in ("png", "jpg", "bmp", "ppm"):
        path = scratch / f"image.{suffix}"
        io.write_image(path, image)
        put(out / "image", path.name, path.read_bytes())
    put(out / "image", "image.pgm", b"P5 9 6 255\n" + image[..., 0].tobytes())


def flows(out: Path, scratch: Path) -> None:
    """The first byte names the format, as in fuzz_flow_file.cpp."""
    flow = np.random.default_rng(1).normal(0, 3, (6, 9, 2)).astype(np.float32)
    io.write_flo(scratch / "flow.flo", flow)
    io.write_pfm(scratch / "flow.pfm", np.concatenate([flow, flow[..., :1]], 2))
    io.write_kitti_flow(scratch / "flow.png", flow)
    for first, suffix in enumerate(("flo", "pfm", "png")):
        put(out / "flow_file", f"flow.{suffix}", bytes([first]) + (scratch / f"flow.{suffix}").read_bytes())


def models(out: Path, scratch: Path) -> None:
    path = scratch / "tiny.safetensors"
    torch.manual_seed(0)
    nn.save_checkpoint(path, nn.FlowNet(width=4), "tiny", UncertaintyLoss(), 2.0)
    data = path.read_bytes()
    length = struct.unpack("<Q", data[:8])[0]
    put(out / "model_metadata", "header.json", data[8 : 8 + length])
    put(out / "model_metadata", "strings.json", b'{"name": "tiny", "flow_scale": "2", "loss": "f=l1"}')


def configurations(out: Path) -> None:
    text = (ROOT / "docs" / "flight.yaml").read_bytes()
    put(out / "config", "flight.yaml", text)
    short = b'model: {path: m.pt}\nsource: {kind: spool, path: f}\nmavlink: {endpoint: "udpout:127.0.0.1:1"}\n'
    put(out / "config", "short.yaml", short + b"safety: {switch_channel: 8}\ntask: {kind: gap}\n")


def streams(out: Path) -> None:
    """A vehicle that is met, armed, in LOITER, with its switch on: as bytes (odd first byte), and as payloads."""
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    vehicle = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    receiver = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    messages = [
        mavlink.MAVLink_heartbeat_message(2, 3, 129, 5, 4, 3),
        mavlink.MAVLink_sys_status_message(receiver, receiver, receiver, 0, 12000, 0, 90, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_rc_channels_message(0, 16, *[1500] * 7, 2000, *[1500] * 10, 200),
        mavlink.MAVLink_attitude_message(0, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0),
        mavlink.MAVLink_local_position_ned_message(0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
        mavlink.MAVLink_param_value_message(b"RC_OVERRIDE_TIME", 1.0, 9, 1000, 0),
        mavlink.MAVLink_param_value_message(b"SYSID_MYGCS", 255.0, 9, 1000, 0),
        mavlink.MAVLink_param_value_message(b"RC_OPTIONS", 32.0, 9, 1000, 0),
        mavlink.MAVLink_command_ack_message(511, 0),
        mavlink.MAVLink_statustext_message(6, b"hello"),
    ]
    kinds = (0, 1, 22, 30, 32, 65, 77, 253)  # the order of fuzz_mavlink.cpp
    raw, framed = b"\1", b"\5"
    for message in messages * 2:
        wire = message.pack(vehicle)
        raw += wire
        framed += bytes([kinds.index(message.get_msgId()), wire[1]]) + wire[10 : 10 + wire[1]]
    put(out / "mavlink", "raw", raw)
    put(out / "mavlink", "framed", framed)
    put(out / "mavlink", "signed", b"\0" + raw[1:])


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: seeds.py FOLDER")
    out = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as scratch:
        images(out, Path(scratch))
        flows(out, Path(scratch))
        models(out, Path(scratch))
    configurations(out)
    streams(out)


if __name__ == "__main__":
    main()
