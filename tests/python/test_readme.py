# SPDX-License-Identifier: MIT
"""The README's quick starts, executed as printed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ajna

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
BUILD = os.environ.get("AJNA_TEST_BUILD_DIR")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working folder with the two frames that the README speaks of: a texture that moves 2 px to the right."""
    texture = np.random.default_rng(0).integers(0, 256, (60, 84, 3), dtype=np.uint8).repeat(2, 0).repeat(2, 1)
    ajna.io.write_image(tmp_path / "frame1.png", np.ascontiguousarray(texture[:, 2:162]))
    ajna.io.write_image(tmp_path / "frame2.png", np.ascontiguousarray(texture[:, 0:160]))
    return tmp_path


def test_commands_come_first() -> None:
    assert re.findall(r"^make \w+", blocks("sh")[0], re.MULTILINE) == ["make demo", "make test"]


@pytest.mark.parametrize("code", blocks("python"), ids=lambda code: code.split("\n")[0])
def test_python_block(code: str, folder: Path) -> None:
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder)
    assert result.returncode == 0, result.stderr
    if "model(" in code:
        assert result.stdout.startswith("(120, 160, 2)\n")
        assert ajna.io.read_image(folder / "flow.png").shape == (120, 160, 3)


def test_shell_block(folder: Path) -> None:
    (script,) = [block for block in blocks("sh") if block.startswith("ajna ")]
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    result = subprocess.run(
        ["sh", "-ec", script], capture_output=True, text=True, cwd=folder, env={**os.environ, "PATH": path}
    )
    assert result.returncode == 0, result.stderr
    assert (folder / "result" / "overview.png").is_file()


@pytest.mark.slow
@pytest.mark.skipif(BUILD is None, reason="AJNA_TEST_BUILD_DIR is not set: no C++ build to install (make test sets it)")
def test_cpp_blocks(folder: Path) -> None:
    (cmake_lists,), (main_cpp,) = blocks("cmake"), blocks("cpp")
    (folder / "CMakeLists.txt").write_text(cmake_lists)
    (folder / "main.cpp").write_text(main_cpp)

    def run(*command: str | Path) -> str:
        result = subprocess.run(command, capture_output=True, text=True, cwd=folder)
        assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
        return result.stdout

    assert BUILD is not None
    run("cmake", "--install", BUILD, "--prefix", folder / "prefix")
    run("cmake", "-S", ".", "-B", "build", "-G", "Ninja", f"-DCMAKE_PREFIX_PATH={folder / 'prefix'}",
        f"-DPython_EXECUTABLE={sys.executable}")  # fmt: skip
    run("cmake", "--build", "build")
    printed = run(folder / "build" / "quickstart", ajna.load().info.path, "frame1.png", "frame2.png")
    assert re.fullmatch(r"flow \d+\.\d\d px, expected error \d+\.\d\d px\n", printed)


def test_links_and_pictures_exist() -> None:
    for target in re.findall(r"\]\(([^)]+)\)", README):
        assert target.startswith("http") or (ROOT / target).exists(), f"README.md names {target}, which is not there"
