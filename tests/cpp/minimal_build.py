# SPDX-License-Identifier: MIT
"""Builds Ajna with AJNA_WITH_VISION=OFF where OpenCV, Eigen and the applications' libraries cannot be found.

Run by CTest: minimal_build.py SOURCE BUILD. Proves that nn, loss, synth, engine and their bindings need LibTorch alone:
nothing of the others on a compile line, all objects compile, the extension links, loads and computes.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

FORBIDDEN = ("OpenCV", "Eigen3", "CLI11", "spdlog", "yaml-cpp")

SMOKE = """
import torch
from ajna import _core
assert _core.with_vision is False, "the extension was built with OpenCV"
import ajna, ajna.nn, ajna.losses
net = ajna.nn.FlowNet(width=8).eval()
with torch.no_grad():
    out = net(torch.zeros(1, 6, 32, 48))
assert out.shape == (1, 4, 32, 48), out.shape
print("AJNA_WITH_VISION=OFF works:", ajna.__file__)
"""


def main(source: Path, build: Path) -> None:
    configure = ["cmake", "-S", source, "-B", build, "-G", "Ninja", f"-DPython_EXECUTABLE={sys.executable}"]
    # Nothing here is run for its speed.
    configure += ["-DAJNA_WITH_VISION=OFF", "-DAJNA_BUILD_PYTHON=ON", "-DCMAKE_CXX_FLAGS_RELEASE=-O0"]
    configure += [f"-DCMAKE_DISABLE_FIND_PACKAGE_{name}=ON" for name in FORBIDDEN]
    subprocess.run(configure, check=True)

    commands = json.loads((build / "compile_commands.json").read_text())
    # Of a source or, where several are compiled together, of the file that includes them in the build folder.
    folders = [re.search(r"/cpp/(?:ajna/)?(\w+)/", entry["file"].removeprefix(str(source))) for entry in commands]
    libraries = {found[1] for found in folders if found}
    missing = {"base", "nn", "loss", "synth", "engine", "bindings"} - libraries
    if missing:
        sys.exit(f"AJNA_WITH_VISION=OFF does not build {sorted(missing)}")
    for entry in commands:
        line = entry["command"].replace(str(build), "").replace(str(source), "")
        if re.search("opencv|eigen|yaml-cpp|spdlog", line, re.IGNORECASE):
            sys.exit(f"a library that AJNA_WITH_VISION=OFF excludes is on the compile line of {entry['file']}:\n{line}")

    subprocess.run(["cmake", "--build", build], check=True)
    extension = next((build / "pkg" / "ajna").glob("_core*.so"))
    needed = subprocess.run(["readelf", "-d", extension], check=True, capture_output=True, text=True).stdout
    if "opencv" in needed:
        sys.exit(f"{extension} is linked to OpenCV:\n{needed}")
    environment = {**os.environ, "PYTHONPATH": str(build / "pkg")}
    subprocess.run([sys.executable, "-c", SMOKE], check=True, env=environment, cwd=build)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
