# SPDX-License-Identifier: MIT
"""What the commands share: errors to sentences, options, results that appear together. Needs no vision."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import typer

from ajna.cli import errors, main, outputs
from ajna.cli.options import parse_size


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ValueError("one\n  two"), 2),
        (FileNotFoundError(2, "No such file or directory", "x.png"), 2),
        (RuntimeError("bad\nException raised from f at g.cpp:1\nframe #0"), 2),
        (ImportError("no vision", name="ajna.io"), 2),
        (KeyboardInterrupt(), 130),
    ],
)
def test_expected_errors_become_one_sentence(
    error: BaseException, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    def app(**_: object) -> None:
        raise error

    assert errors.run(app, []) == code  # type: ignore[arg-type]
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert "frame #0" not in text


@pytest.mark.parametrize("error", [KeyError("x"), TypeError("x"), NotImplementedError("x"), ImportError("x", name="y")])
def test_bugs_keep_their_traceback(error: BaseException) -> None:
    def app(**_: object) -> None:
        raise error

    with pytest.raises(type(error)):
        errors.run(app, [])  # type: ignore[arg-type]


def test_traceback_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--traceback", "predict", "no.png", "no.png", "--out", str(tmp_path / "out")]) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(("text", "size"), [(None, None), ("320x240", (320, 240)), ("1x1", (1, 1))])
def test_parse_size(text: str | None, size: tuple[int, int] | None) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "x", "0x1", "1x0", "1.5x2", "3X4", " 3x4", "3x4x5", "16385x1", "9999999x1"])
def test_parse_size_refuses(text: str) -> None:
    with pytest.raises(ValueError, match="size"):
        parse_size(text)


def test_staged_folder_is_all_or_nothing(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b"

    def fail() -> None:
        with outputs.staged_folder(target) as stage:
            (stage / "one").write_text("1")
            raise typer.Abort

    with pytest.raises(typer.Abort):
        fail()
    assert not list(tmp_path.iterdir())
    with outputs.staged_folder(target) as stage:
        (stage / "one").write_text("1")
        assert os.listdir(target) == [stage.name]
    assert os.listdir(target) == ["one"]
