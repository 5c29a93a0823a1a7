# SPDX-License-Identifier: MIT
"""The loss study's table, record and picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ajna.losses import presets
from ajna.studies import regression
from ajna.studies.loss_study import MAX_DEVIATION, MIN_RHO, Cell
from ajna.studies.printed_forms import PrintedResult

RgbImage = NDArray[np.uint8]

_TITLES = {
    "gaussian": "Gaussian",
    "laplace": "Laplace",
    "student_t": "Student-t (5)",
    "skewed": "skewed (gamma)",
    "bimodal": "bimodal",
}

_CLAIM = (
    "A network trained with an admissible loss (see [losses](losses.md)) knows, at every place, how large its own "
    "error is on average, whatever the noise's distribution: at the optimum kappa(Y) = E[f]. To see whether "
    "training gets there, a small network (two hidden layers) is trained for every admissible preset and five "
    "kinds of noise on y = sin(3x) + s(x) e, with s from 0.6 to 2 and e of mean 0 and variance 1: Gaussian, "
    "Laplace, Student-t with 5 degrees of freedom, a shifted gamma distribution (skewness 1.4), and two narrow "
    "modes. Every step draws new data from x in [-1.2, 1.2]. E[f] of the trained network's own prediction is then "
    "measured on fresh noise at {places} places in [-1, 1] and held against what the network says."
)
_READING = (
    "Y is Table 3's a (1/a where a is a confidence, which falls as errors rise). Presets with the same terms "
    "share a row. The angular loss sees directions, turned by y in units of 0.12 rad."
)
_PRINTED = (
    "Four presets stand in Table 3 in a form that the check refuses. No network here, to isolate the loss: a "
    "prediction and a raw of its own for each of 12 scales of noise (0.3 to 3 times its unit deviation) and the "
    "five kinds of noise. Where raw must end follows from the curves of h and g: downhill from its start, to the "
    "first local minimum of h E[f] + lam g, or out of the domain where there is none. Bins within 15 % of an "
    "error at which a minimum vanishes are not judged."
)


@dataclass
class Study:
    """Both halves of the loss study."""

    cells: list[Cell]
    printed: list[PrintedResult]
    seed: int
    steps: int
    seconds: float

    @property
    def holds(self) -> bool:
        """Whether every claim does."""
        return all(cell.holds for cell in self.cells) and all(result.holds for result in self.printed)

    @property
    def failures(self) -> list[str]:
        """The claims that do not hold, one sentence each."""
        found = [
            f"{cell.presets[0]} under {cell.noise} noise: rho {cell.rho:.3f}, kappa off by {100 * cell.deviation:.1f} %"
            for cell in self.cells
            if not cell.holds
        ]
        found += [
            f"{result.preset} from raw = {result.start:g}: predicted: {result.sentence()}; measured: {result.outcome()}"
            for result in self.printed
            if not result.holds
        ]
        return found

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "seed": self.seed,
            "steps": self.steps,
            "seconds": self.seconds,
            "holds": self.holds,
            "admissible": [
                {
                    "presets": cell.presets,
                    "noise": cell.noise,
                    "rho": cell.rho,
                    "rho_of_g": cell.rho_of_g,
                    "deviation": cell.deviation,
                    "deviation_mean": cell.mean_deviation,
                    "holds": cell.holds,
                }
                for cell in self.cells
            ],
            "printed": [
                {
                    "preset": result.preset,
                    "start": result.start,
                    "check": result.reason,
                    "predicted": result.sentence(),
                    "measured": result.outcome(),
                    "holds": result.holds,
                }
                for result in self.printed
            ],
        }


def markdown(study: Study, picture: str) -> str:
    """The study as a page; `picture` is the path of its plot, seen from there."""
    noises = list(dict.fromkeys(cell.noise for cell in study.cells))
    by_loss: dict[str, dict[str, Cell]] = {}
    for cell in study.cells:
        by_loss.setdefault(", ".join(f"`{name}`" for name in cell.presets), {})[cell.noise] = cell
    kappas = {entry.name: entry.kappa for entry in presets()}
    places = study.cells[0].x.numel() if study.cells else 0
    lines = [
        "# What the published losses teach a network to say",
        "",
        "This page is written by `ajna study loss --out docs`; its figures are that run's "
        f"(seed {study.seed}, {study.steps} steps, {study.seconds:.0f} s).",
        "",
        "## The claim",
        "",
        _CLAIM.format(places=places),
        "",
        f"Claimed for every cell: Pearson's rho of Y and E[f] above {MIN_RHO}, and |kappa(Y) / E[f] - 1| at most "
        f"{100 * MAX_DEVIATION:.0f} % at **every** place. {_READING}",
        "",
        "| preset | kappa(a) | " + " | ".join(_TITLES[noise] for noise in noises) + " |",
        "|---|---|" + "---|" * len(noises),
    ]
    for names, cells in by_loss.items():
        texts = [
            f"{cells[noise].rho:.3f}, {100 * cells[noise].deviation:.1f} %"
            + ("" if cells[noise].holds else " **fails**")
            for noise in noises
        ]
        kappa = kappas[next(iter(cells.values())).presets[0]]
        lines.append(f"| {names} | {kappa} | " + " | ".join(texts) + " |")
    if study.cells:
        worst = max(study.cells, key=lambda cell: cell.deviation)
        lowest = min(study.cells, key=lambda cell: cell.rho)
        g_low = min(study.cells, key=lambda cell: cell.rho_of_g)
        mean = sum(cell.mean_deviation for cell in study.cells) / len(study.cells)
        lines += [
            "",
            "Each cell: rho, largest deviation over the grid. "
            f"{sum(cell.holds for cell in study.cells)} of {len(study.cells)} cells hold; lowest rho {lowest.rho:.3f} "
            f"({lowest.presets[0]}, {_TITLES[lowest.noise]}), largest deviation {100 * worst.deviation:.1f} % "
            f"({worst.presets[0]}, {_TITLES[worst.noise]}), mean deviation {100 * mean:.1f} %. With g(a), which "
            f"`uncertainty()` returns, in place of a, the lowest rho is {g_low.rho_of_g:.3f} ({g_low.presets[0]}, "
            f"{_TITLES[g_low.noise]}): a logarithm of the error is not linear in it, though it ranks alike.",
        ]
    lines += ["", f"![kappa(Y) against E[f], and where the printed forms end]({picture})"]
    lines += [
        "",
        "## The rows that cannot be meant as printed",
        "",
        _PRINTED,
        "",
        "| printed form | check() | raw starts at | predicted | measured | |",
        "|---|---|---|---|---|---|",
    ]
    for result in study.printed:
        lines.append(
            f"| `{result.preset}` | {result.reason} | {result.start:g} | {result.sentence()} | {result.outcome()} | "
            f"{'as predicted' if result.holds else '**not as predicted**'} |"
        )
    return "\n".join(lines) + "\n"


# --- picture ---------------------------------------------------------------------------------------------------------


def draw(study: Study) -> RgbImage:
    """kappa(Y) against E[f] for every noise, an example of the data, and the ends of the printed forms."""
    noises = list(dict.fromkeys(cell.noise for cell in study.cells))
    forms = list(dict.fromkeys(result.preset for result in study.printed))
    columns = max(len(noises), len(forms) + 1)
    figure = Figure(figsize=(3.0 * columns, 6.6), dpi=80, facecolor="white", layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.subplots(2, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    colors = [matplotlib.colormaps["tab20"](index) for index in range(20)]
    losses = list(dict.fromkeys(cell.presets[0] for cell in study.cells))
    for axes, noise in zip(grid[0], noises, strict=False):
        axes.set_axis_on()
        _draw_noise(axes, [cell for cell in study.cells if cell.noise == noise], losses, colors)
        axes.set_title(f"{_TITLES[noise]} noise", fontsize=10)
    if study.cells:
        grid[0][0].set_ylabel("what the network expects: kappa(Y)", fontsize=9)
        grid[1][0].set_axis_on()
        _draw_data(grid[1][0], study.cells)
    for axes, form in zip(grid[1][1:], forms, strict=False):
        axes.set_axis_on()
        _draw_form(axes, [result for result in study.printed if result.preset == form])
        axes.set_title(form, fontsize=10)
    handles, labels = grid[0][0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=7, fontsize=8, frameon=False, markerscale=2)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_noise(axes: Axes, cells: list[Cell], losses: list[str], colors: Any) -> None:
    ends = np.array([0.02, 8.0])
    axes.fill_between(ends, ends * (1 - MAX_DEVIATION), ends * (1 + MAX_DEVIATION), color="0.88", linewidth=0)
    axes.plot(ends, ends, color="0.6", linewidth=0.8)
    for cell in cells:
        color = colors[losses.index(cell.presets[0]) % len(colors)]
        axes.plot(cell.measured, cell.expected, ".", color=color, markersize=3, label=cell.presets[0])
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends)
    axes.set_xlabel("measured E[f]", fontsize=9)
    axes.tick_params(labelsize=8)


def _draw_data(axes: Axes, cells: list[Cell]) -> None:
    """The data, and what the paper's own loss says about it."""
    cell = next((c for c in cells if "ajna2023" in c.presets and c.noise == "gaussian"), cells[0])
    generator = torch.Generator().manual_seed(0)
    x = torch.linspace(regression.X_MIN, regression.X_MAX, 600)
    y = regression.mean(x) + regression.scale(x) * regression.NOISES[cell.noise]((600,), generator)
    axes.plot(x, y, ".", color="0.75", markersize=2)
    axes.fill_between(
        cell.x, cell.prediction - cell.expected, cell.prediction + cell.expected, color="C0", alpha=0.3, linewidth=0
    )
    axes.plot(cell.x, cell.prediction, color="C0")
    axes.set_title(f"{cell.presets[-1]}: prediction ± kappa(Y)", fontsize=10)
    axes.set_xlabel("x", fontsize=9)
    axes.tick_params(labelsize=8)


def _draw_form(axes: Axes, results: list[PrintedResult]) -> None:
    """Where raw has ended over E[f]; for a form that repels predictions, the error over what could be had."""
    for index, result in enumerate(results):
        label = f"raw starts at {result.start:g}"
        if result.repels:
            axes.plot(
                result.attainable.flatten(), result.measured.flatten(), "x+"[index], color=f"C{index}", label=label
            )
            continue
        order = result.attainable.flatten().argsort()
        error, raw = result.attainable.flatten()[order], result.raw.flatten()[order]
        axes.plot(error, raw, "x+"[index], color=f"C{index}", label=label)
        predicted = result.predicted.flatten()[order]
        finite = predicted.isfinite()
        axes.plot(error[finite], predicted[finite], color=f"C{index}", linewidth=1, alpha=0.6)
    if results[0].repels:
        ends = [0.0, float(results[0].attainable.max())]
        axes.plot(ends, ends, color="0.6", linewidth=0.8)
        axes.set_xlabel("E[f] that could be had (rad)", fontsize=9)
        axes.set_ylabel("E[f] after training (rad)", fontsize=9)
    else:
        axes.axhspan(axes.get_ylim()[0], results[0].raw_min, color="0.9", zorder=0)
        axes.set_xlabel("E[f]", fontsize=9)
        axes.set_ylabel("raw after training (grey: left the domain)", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=8, frameon=False)
