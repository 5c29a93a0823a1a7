# SPDX-License-Identifier: MIT
"""Reading a run folder: its logged scalars, curves of them, and what the uncertainty looked like when."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from ajna.training.progress import PICTURE_COLUMNS
from ajna.viz import RgbImage

_DPI = 100


class Series(NamedTuple):
    """One scalar over the steps of a run."""

    steps: NDArray[np.int64]
    values: NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """What a run logged.

    Attributes:
        folder: the run folder.
        scalars: name -> its values, e.g. ``train/loss``, ``val/epe``.
        pictures: (step, file) of the validation pictures, in order.
    """

    folder: Path
    scalars: dict[str, Series]
    pictures: tuple[tuple[int, Path], ...]


def read_run(folder: str | Path) -> Run:
    """Read a run folder; where resumed runs logged a step twice, the later word counts.

    Raises:
        FileNotFoundError: the folder holds no log.
    """
    folder = Path(folder)
    logs = sorted(folder.glob("csv/version_*/metrics.csv"), key=lambda path: int(path.parent.name.rpartition("_")[2]))
    if not logs:
        raise FileNotFoundError(f"'{folder}' holds no csv/version_*/metrics.csv: give the folder of a run")
    found: dict[str, dict[int, float]] = {}
    for log in logs:
        with log.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                if not row.get("step"):
                    continue  # the last line of a killed run may be cut
                for name, text in row.items():
                    if name and name != "step" and text:
                        found.setdefault(name, {})[int(row["step"])] = float(text)
    scalars = {}
    for name, values in found.items():
        steps = sorted(values)
        scalars[name] = Series(np.array(steps), np.array([values[step] for step in steps]))
    pictures = [(int(match[1]), path) for path in folder.glob("pictures/step-*.png") if (match := _step(path))]
    return Run(folder, scalars, tuple(sorted(pictures)))


def _step(path: Path) -> re.Match[str] | None:
    return re.fullmatch(r"step-(\d+)\.png", path.name)


def smoothed(values: NDArray[np.float64], window: int) -> NDArray[np.float64]:
    """Mean over the latest ``window`` values up to each; fewer at the beginning. NaN values are left out."""
    known = np.isfinite(values)
    total = np.cumsum(np.where(known, values, 0.0))
    count = np.cumsum(known)
    total[window:], count[window:] = total[window:] - total[:-window], count[window:] - count[:-window]
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)


# --- curves --------------------------------------------------------------------------------------------------------

#: title -> the scalars drawn, with their labels
_LEARNING: dict[str, dict[str, str]] = {
    "end-point error, px": {"train/zero_epe": "of zero flow", "train/epe": "training", "val/epe": "validation"},
    "loss": {"train/loss": "training", "val/loss": "validation"},
    "learning rate": {"train/lr": ""},
    "samples per second": {"train/samples_per_s": ""},
}
_NOISY = ("train/loss", "train/epe", "train/zero_epe")
_UNCERTAINTY: dict[str, dict[str, str]] = {
    "rank correlation with the error": {"val/spearman": ""},
    "AUSE: 0 is a perfect order of the pixels": {"val/ause": ""},
    "occlusion AUC: 0.5 is chance": {"val/occlusion_auc": ""},
    "mean expected / mean actual error: 1 is right": {"val/expected_ratio": ""},
}


def learning_curves(run: Run, window: int = 20) -> RgbImage:
    """Error, loss (means over ``window`` values in training), learning rate and speed over steps: RGB uint8."""
    return _panels(run, _LEARNING, window)


def uncertainty_curves(run: Run) -> RgbImage:
    """What the uncertainty was worth after each validation: RGB uint8."""
    return _panels(run, _UNCERTAINTY, 1)


def _panels(run: Run, panels: Mapping[str, Mapping[str, str]], window: int) -> RgbImage:
    chosen = {title: lines for title, lines in panels.items() if any(name in run.scalars for name in lines)}
    if not chosen:
        raise ValueError(
            f"run '{run.folder}' logged none of {', '.join(n for lines in panels.values() for n in lines)}"
        )
    columns = 2
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(10, 3.2 * rows), dpi=_DPI, layout="constrained")
    for index, (title, lines) in enumerate(chosen.items()):
        axes = figure.add_subplot(rows, columns, index + 1)
        for name, label in lines.items():
            if name in run.scalars:
                _draw(axes, run.scalars[name], label, window if name in _NOISY else 1)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("step", fontsize=9)
        axes.tick_params(labelsize=9)
        axes.grid(alpha=0.3)
        if any(lines.values()):
            axes.legend(fontsize=9, frameon=False)
    return _rgb(figure)


def _draw(axes: Axes, series: Series, label: str, window: int) -> None:
    marker = "o" if len(series.steps) <= 20 else ""
    axes.plot(series.steps, smoothed(series.values, window), label=label or None, marker=marker, markersize=3)


def _rgb(figure: Figure) -> RgbImage:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


# --- pictures ------------------------------------------------------------------------------------------------------


def picture_parts(path: str | Path) -> list[dict[str, RgbImage]]:
    """A validation picture taken apart: per pair frame 1, frame 2, true flow, flow, expected error, true error.

    Raises:
        ValueError: the file is no such picture.
    """
    with Image.open(path) as opened:
        text, picture = getattr(opened, "text", {}), np.asarray(opened.convert("RGB"))
    height, width = picture.shape[:2]
    pairs = int(text.get("pairs", 0)) or _stacked(picture)
    if width % len(PICTURE_COLUMNS) or not pairs or height % pairs:
        raise ValueError(f"'{path}' is no validation picture of a run: give one of its pictures/step-*.png")
    cells = picture.reshape(pairs, height // pairs, len(PICTURE_COLUMNS), width // len(PICTURE_COLUMNS), 3)
    return [dict(zip(PICTURE_COLUMNS, row.transpose(1, 0, 2, 3), strict=True)) for row in cells]


def _stacked(picture: RgbImage) -> int:
    """How many pairs a picture of an older run holds, which does not say so: of the usual shape 4:3, if possible."""
    height, width = picture.shape[0], picture.shape[1] // len(PICTURE_COLUMNS)
    return round(height / (0.75 * width)) if width else 0


def history(run: Run, pair: int = 0, count: int = 5) -> RgbImage:
    """One validation pair over the run, a row per step: flow, expected and true error beside frame 1 and the true flow.

    Args:
        run: as ``read_run`` gives it.
        pair: which of the validation pairs.
        count: rows, spread evenly over the run's pictures, the first and the last among them.

    Raises:
        ValueError: a run without pictures, or a pair that they do not have.
    """
    if not run.pictures:
        raise ValueError(f"run '{run.folder}' holds no pictures/step-*.png: it has not been validated")
    places = sorted({round(x) for x in np.linspace(0, len(run.pictures) - 1, min(count, len(run.pictures)))})
    rows = []
    for place in places:
        step, path = run.pictures[place]
        parts = picture_parts(path)
        if not 0 <= pair < len(parts):
            raise ValueError(f"pair {pair} is not in the pictures of '{run.folder}': give 0 to {len(parts) - 1}")
        rows.append((step, parts[pair]))
    return _labelled(rows, ("frame 1", "true flow", "flow", "expected error", "true error"))


def _labelled(rows: Sequence[tuple[int, Mapping[str, RgbImage]]], columns: Sequence[str]) -> RgbImage:
    height, width = rows[0][1][columns[0]].shape[:2]
    cell = 1.9
    figure = Figure(
        figsize=(cell * len(columns) + 0.3, (cell * height / width + 0.05) * len(rows) + 0.3),
        dpi=_DPI,
        layout="constrained",
    )
    for i, (step, parts) in enumerate(rows):
        for j, name in enumerate(columns):
            axes = figure.add_subplot(len(rows), len(columns), i * len(columns) + j + 1)
            axes.imshow(parts[name])
            axes.set_xticks([])
            axes.set_yticks([])
            if i == 0:
                axes.set_title(name, fontsize=9)
            if j == 0:
                axes.set_ylabel(f"step {step}", fontsize=9)
    return _rgb(figure)
