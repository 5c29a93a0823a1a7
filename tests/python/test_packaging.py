# SPDX-License-Identifier: MIT
"""The installed package: complete, self-contained, tied to its torch, and really the one under test."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import ajna
from ajna import _core

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = Path(ajna.__file__).parent
EXTENSION = Path(_core.__file__)

developing = pytest.mark.skipif("PYTHONPATH" in os.environ, reason="PYTHONPATH is set: not the installed package")


@developing
def test_the_source_tree_is_out_of_reach() -> None:
    assert "site-packages" in PACKAGE.parts
    assert (ROOT / "python") not in [Path(entry).resolve() for entry in sys.path]
    assert EXTENSION.parent == PACKAGE


@developing
def test_installed_files_are_the_source_files() -> None:
    """Every file of python/ajna is installed with its content, and the extension beside them; nothing else."""
    sources = {p.relative_to(ROOT / "python/ajna") for p in (ROOT / "python/ajna").rglob("*") if p.is_file()}
    sources = {p for p in sources if "__pycache__" not in p.parts}
    installed = {p.relative_to(PACKAGE) for p in PACKAGE.rglob("*") if p.is_file() and "__pycache__" not in p.parts}
    assert installed - sources == {Path(EXTENSION.name)}
    assert sources - installed == set()
    stale = [p for p in sources if (PACKAGE / p).read_bytes() != (ROOT / "python/ajna" / p).read_bytes()]
    assert stale == [], "installed files differ from the sources: run `make setup`"
    assert Path("py.typed") in installed


@developing
def test_distribution_lists_package_files_only() -> None:
    files = importlib.metadata.files("ajna")
    assert files is not None
    outside = {f.parts[0] for f in files if f.parts[0] != "ajna" and not f.parts[0].startswith("ajna-")}
    assert outside <= {".."}, outside  # ../../../bin/ajna
    assert not [f for f in files if f.suffix in {".a", ".hpp", ".h", ".cmake", ".cpp"}]


@developing
def test_requires_the_torch_minor_version_that_it_was_built_with() -> None:
    requires = importlib.metadata.requires("ajna") or []
    (torch_requirement,) = [r for r in requires if re.match(r"torch\b(?!metrics)", r)]
    major, minor = _core.build_torch_version.split(".")[:2]
    assert torch_requirement.replace(" ", "") == f"torch=={major}.{minor}.*"


@developing
@pytest.mark.skipif(shutil.which("readelf") is None, reason="readelf (binutils) is not installed")
def test_extension_finds_torch_beside_the_package_and_nowhere_else() -> None:
    dynamic = subprocess.run(["readelf", "-d", EXTENSION], check=True, capture_output=True, text=True).stdout
    paths = re.findall(r"\((?:RPATH|RUNPATH)\).*\[(.*)\]", dynamic)
    assert paths == ["$ORIGIN/../torch/lib"]
    assert Path(torch.__file__).parent.parent == PACKAGE.parent


def test_runs_from_an_empty_folder(tmp_path: Path) -> None:
    code = "import torch, ajna.nn; print(tuple(ajna.nn.FlowNet(width=8)(torch.zeros(1, 6, 32, 32)).shape))"
    result = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=tmp_path)
    assert result.stdout.strip() == "(1, 4, 32, 32)"
    assert list(tmp_path.iterdir()) == []


def test_import_order_does_not_matter() -> None:
    """The extension needs torch's symbols: the package must load torch itself."""
    subprocess.run([sys.executable, "-c", "import ajna, torch"], check=True)
    subprocess.run([sys.executable, "-c", "import torch, ajna"], check=True)


def test_import_changes_no_global_state() -> None:
    code = """
import sys, torch
before = (torch.get_num_threads(), torch.get_default_dtype(), torch.are_deterministic_algorithms_enabled(),
          torch.initial_seed(), torch.is_grad_enabled())
import ajna
after = (torch.get_num_threads(), torch.get_default_dtype(), torch.are_deterministic_algorithms_enabled(),
         torch.initial_seed(), torch.is_grad_enabled())
assert before == after, (before, after)
assert "matplotlib" not in sys.modules and "lightning" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
