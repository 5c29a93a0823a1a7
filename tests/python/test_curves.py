# SPDX-License-Identifier: MIT
"""Reading run folders: scalars over resumes, smoothing, pictures taken apart, drawings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("lightning")

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ajna.training.curves import history, learning_curves, picture_parts, read_run, smoothed, uncertainty_curves

HEADER = "epoch,step,train/loss,val/ause,val/epe\n"


def write_log(folder: Path, version: int, lines: str) -> None:
    path = folder / f"csv/version_{version}/metrics.csv"
    path.parent.mkdir(parents=True)
    path.write_text(HEADER + lines)


def write_picture(path: Path, pairs: int, shade: int, told: bool = True) -> None:
    """Pairs of 8x6; cell (row, column) has the colour (shade, row, column)."""
    picture = np.zeros((pairs, 6, 6, 8, 3), np.uint8)
    picture[..., 0] = shade
    picture[..., 1] = np.arange(pairs)[:, None, None, None]
    picture[..., 2] = np.arange(6)[None, None, :, None]
    text = PngInfo()
    if told:
        text.add_text("pairs", str(pairs))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture.reshape(pairs * 6, 48, 3)).save(path, pnginfo=text)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_log(tmp_path, 0, "0,1,4.0,,\n0,2,3.0,,\n0,2,,0.5,9.0\n0,3,8.0,,\n0,4")  # killed in its last line
    write_log(tmp_path, 2, "0,3,2.0,,\n0,3,,0.25,6.0\n")
    write_log(tmp_path, 10, "0,4,1.0,,\n")
    for step in (3, 20, 100):
        write_picture(tmp_path / f"pictures/step-{step:07d}.png", 3, step)
    (tmp_path / "pictures/notes.txt").write_text("")
    return tmp_path


def test_resumed_runs_are_read_as_one(folder: Path) -> None:
    run = read_run(folder)
    assert run.scalars["train/loss"].steps.tolist() == [1, 2, 3, 4]
    assert run.scalars["train/loss"].values.tolist() == [4, 3, 2, 1], "what was done again counts"
    assert run.scalars["val/ause"].steps.tolist() == [2, 3]
    assert [step for step, _ in run.pictures] == [3, 20, 100]
    with pytest.raises(FileNotFoundError, match="give the folder of a run"):
        read_run(folder / "pictures")


def test_smoothing_is_the_mean_of_the_latest() -> None:
    values = np.array([1.0, 3.0, np.nan, 5.0, 7.0, 9.0])
    window = 3
    expected = [np.nanmean(values[max(0, n - window + 1) : n + 1]) for n in range(6)]
    assert smoothed(values, window) == pytest.approx(expected)
    assert np.isnan(smoothed(np.array([np.nan, 1.0]), 1)).tolist() == [True, False]
    assert smoothed(values[:2], 10).tolist() == [1, 2]


@pytest.mark.parametrize("told", [True, False])
def test_pictures_come_apart(tmp_path: Path, told: bool) -> None:
    write_picture(tmp_path / "p.png", 3, 7, told)
    parts = picture_parts(tmp_path / "p.png")
    assert len(parts) == 3 and next(iter(parts[0])) == "frame 1" and list(parts[0])[-1] == "true error"
    for row, part in enumerate(parts):
        for column, cell in enumerate(part.values()):
            assert cell.shape == (6, 8, 3) and (cell == [7, row, column]).all()
    Image.fromarray(np.zeros((5, 7, 3), np.uint8)).save(tmp_path / "q.png")
    with pytest.raises(ValueError, match="is no validation picture"):
        picture_parts(tmp_path / "q.png")


def test_curves_and_history_are_drawn(folder: Path) -> None:
    run = read_run(folder)
    drawings = [learning_curves(run, 2), uncertainty_curves(run), history(run, 1, 2), history(run, 1, 9)]
    assert all(d.dtype == np.uint8 and d.ndim == 3 and d.std() > 5 for d in drawings)
    assert drawings[3].shape[0] > drawings[2].shape[0], "a row per step"
    # The cells of the pair that was asked for, at both ends of the run.
    shown = {tuple(color) for color in drawings[2].reshape(-1, 3)}
    assert {(3, 1, 0), (3, 1, 2), (100, 1, 4), (100, 1, 5)} <= shown and (3, 0, 0) not in shown
    with pytest.raises(ValueError, match="pair 3 is not in the pictures .* give 0 to 2"):
        history(run, 3)
    for path in folder.glob("pictures/*.png"):
        path.unlink()
    with pytest.raises(ValueError, match="it has not been validated"):
        history(read_run(folder))
    write_log(folder, 11, "")
    (folder / "csv/version_11/metrics.csv").write_text("step,x\n1,2\n")
    only = read_run(folder)
    only.scalars.clear()
    with pytest.raises(ValueError, match="logged none of train/zero_epe"):
        learning_curves(only)
