# SPDX-License-Identifier: MIT
"""The notebooks run from the first cell to the last, and are committed with their pictures."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="needs the notebooks extra")

FOLDER = Path(__file__).parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
MAX_BYTES = 3_000_000  # pictures belong into JPEG, see the notebooks' show()
FRAMES = "/usr/share/doc/opencv-doc/examples/data"

pytestmark = pytest.mark.skipif(not NOTEBOOKS, reason="the source tree's notebooks/ is not here")
notebooks = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_cells(path: Path) -> list:
    return [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]


@pytest.mark.slow
@pytest.mark.parametrize("frames", ["as_found", "without_opencv_doc"])
@notebooks
def test_runs(path: Path, frames: str, tmp_path: Path) -> None:
    for package in ("nbmake", "ipykernel"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"needs the notebooks extra ({package})")
    text = path.read_text()
    if "ajna.sim" in text:
        pytest.importorskip("mujoco", reason="needs the sim extra")
        from ajna.sim.gl import NoRenderingError, rendering_backend

        try:
            rendering_backend()
        except NoRenderingError as error:
            pytest.skip(str(error))
    if frames == "without_opencv_doc":
        if FRAMES not in text:
            pytest.skip("does not use the frames of opencv-doc")
        text = text.replace(FRAMES, "/nowhere")
    copy = tmp_path / path.name
    copy.write_text(text)
    command = [sys.executable, "-m", "pytest", "--nbmake", "--nbmake-timeout=1200", "-p", "no:cacheprovider", copy.name]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout[-4000:] + result.stderr[-2000:]


@notebooks
def test_is_committed_executed_with_pictures(path: Path) -> None:
    hint = f"run: python tools/execute_notebooks.py notebooks/{path.name}"
    cells = code_cells(path)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1)), hint
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert sum("image/jpeg" in output.get("data", {}) for output in outputs) >= 3, hint
    assert path.stat().st_size < MAX_BYTES


@notebooks
def test_holds_nothing_of_the_machine_that_ran_it(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert not any("execution" in cell.metadata for cell in notebook.cells)
    text = "\n".join(
        str(part) for cell in code_cells(path) for part in [cell.source, *(o.get("text", "") for o in cell.outputs)]
    )
    assert not re.search(r"/(work|home|root|Users)/", text)
