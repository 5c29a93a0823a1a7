# SPDX-License-Identifier: MIT
"""Several result files that appear together or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

import typer


class Report(Protocol):
    """A result that can be read by people and by programs."""

    def to_markdown(self) -> str: ...

    def to_json(self) -> object: ...


def write_report(result: Report, name: str, stage: Path | None) -> None:
    """``name``.md and ``name``.json into ``stage``, a folder of :func:`staged_folder`; nothing where there is none."""
    if stage is not None:
        (stage / f"{name}.md").write_text(result.to_markdown())
        (stage / f"{name}.json").write_text(_record(result))


def print_report(result: Report, as_json: bool) -> None:
    """JSON or Markdown to standard output: to be called once the files are in their place."""
    typer.echo(_record(result) if as_json else result.to_markdown(), nl=as_json)


def _record(result: Report) -> str:
    return json.dumps(result.to_json(), indent=2)


def check_folder(folder: Path) -> None:
    """Fail early, before minutes of work, where ``folder`` can neither be written nor made. Creates nothing.

    Raises:
        ValueError: where a file is in the way; RuntimeError where the system refuses.
    """
    nearest = folder
    while not os.path.lexists(nearest) and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir():
        raise ValueError(f"output folder '{folder}' cannot be made because '{nearest}' is a file: choose another --out")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise RuntimeError(f"output folder '{folder}' is not writable: choose another --out")


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """``folder`` and its parents exist inside the block; after an exception those made here are gone again.

    Raises:
        ValueError, RuntimeError: as :func:`check_folder`.
    """
    check_folder(folder)
    made: list[Path] = []
    try:
        try:
            for path in reversed([path for path in (folder, *folder.parents) if not path.exists()]):
                path.mkdir()
                made.append(path)
        except OSError as error:
            raise _not_writable(folder, error) from error
        yield
    except BaseException:
        for path in reversed(made):
            with suppress(OSError):  # someone else has put something there
                path.rmdir()
        raise


@contextmanager
def staged_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder inside ``folder`` (made if missing), whose files move into it when the block ends well.

    After an exception nothing new is left, not even ``folder`` where it was made here.

    Raises:
        ValueError, RuntimeError: as :func:`check_folder`, and ValueError where a folder has the name of a file.
    """
    with made_folder(folder):
        try:
            stage = Path(tempfile.mkdtemp(dir=folder, prefix=".ajna-"))
        except OSError as error:
            raise _not_writable(folder, error) from error
        try:
            yield stage
            files = sorted(stage.iterdir())
            for file in files:
                if (folder / file.name).is_dir():
                    raise ValueError(f"output '{folder / file.name}' is a folder: remove it or choose another --out")
            for file in files:
                os.replace(file, folder / file.name)
        finally:
            shutil.rmtree(stage, ignore_errors=True)


def _not_writable(folder: Path, error: OSError) -> RuntimeError:
    return RuntimeError(f"output folder '{folder}' is not writable ({error.strerror}): choose another --out")
