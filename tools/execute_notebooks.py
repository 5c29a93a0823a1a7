#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Run notebooks and keep their pictures: python tools/execute_notebooks.py [--check] [NOTEBOOK...]

Without names all of notebooks/ are run. Time stamps and versions stay out of the files, so that a second run changes
only what the cells print. With --check nothing is written: the exit code says whether all cells run.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
TIMEOUT_S = 1800


def execute(path: Path) -> nbformat.NotebookNode:
    """The executed notebook, free of time stamps. Raises CellExecutionError where a cell fails."""
    notebook = nbformat.read(path, as_version=4)
    # In a folder of its own: a notebook must not depend on, or leave anything in, the source tree.
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook, timeout=TIMEOUT_S, kernel_name="python3", resources={"metadata": {"path": folder}}
        )
        client.execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return notebook


def write(notebook: nbformat.NotebookNode, path: Path) -> None:
    """Replace the file at once or not at all."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}", suffix=".ipynb")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            nbformat.write(notebook, stream)
        Path(temporary).chmod(0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if every notebook ran, 1 if a cell failed, 2 for a missing file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all of notebooks/")
    parser.add_argument("--check", action="store_true", help="run only, write nothing")
    arguments = parser.parse_args(argv)
    failed = 0
    for path in arguments.notebooks or sorted(NOTEBOOKS.glob("*.ipynb")):
        if not path.is_file():
            print(f"notebook '{path}' does not exist; notebooks are in '{NOTEBOOKS}'.", file=sys.stderr)
            return 2
        try:
            notebook = execute(path)
        except CellExecutionError as error:
            print(f"{path}: a cell failed\n{error}", file=sys.stderr)
            failed = 1
            continue
        if not arguments.check:
            write(notebook, path)
        print(f"{path}: ran {sum(cell.cell_type == 'code' for cell in notebook.cells)} cells")
    return failed


if __name__ == "__main__":
    sys.exit(main())
