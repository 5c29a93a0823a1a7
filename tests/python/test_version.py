# SPDX-License-Identifier: MIT
"""One version, wherever it is asked for."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import torch

import ajna
from ajna import _core

ROOT = Path(__file__).resolve().parents[2]


def test_package_extension_metadata_and_cmake_agree() -> None:
    match = re.search(r"project\(ajna VERSION ([0-9.]+)", (ROOT / "CMakeLists.txt").read_text())
    assert match
    assert ajna.__version__ == _core.__version__ == importlib.metadata.version("ajna") == match[1]


def test_version_is_written_in_one_place_only() -> None:
    assert re.search(r'(?m)^\s*version\s*=\s*"', (ROOT / "pyproject.toml").read_text()) is None


def test_changelog_knows_the_version() -> None:
    assert f"## {_core.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_extension_names_the_torch_it_was_built_with() -> None:
    assert _core.build_torch_version.split(".")[:2] == torch.__version__.split(".")[:2]


def test_command_line_prints_it() -> None:
    command = [sys.executable, "-m", "ajna.cli", "--version"]
    result = subprocess.run(command, check=True, capture_output=True, text=True)
    assert _core.__version__ in result.stdout
    assert torch.__version__ in result.stdout
