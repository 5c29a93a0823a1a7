# SPDX-License-Identifier: MIT
"""Pictures of what a loss is made of: h, g and kappa of the published losses, and where the loss has its minimum."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ajna import _core
from ajna.studies.loss_study import same_loss

RgbImage = NDArray[np.uint8]

_POINTS = 601
_LABELS = {"h": "attenuation h(a(raw))", "g": "penalty lam g(a(raw))", "kappa": "kappa(raw) = E[f] at the optimum"}


def _colors(names: Sequence[str]) -> dict[str, Any]:
    return {name: matplotlib.colormaps["tab20"](index % 20) for index, name in enumerate(names)}


def _curves(name: str, raw_min: float, raw_max: float) -> dict[str, torch.Tensor]:
    """raw, h, g (times lam), kappa of a preset, float64 [601]; printed forms do not warn."""
    loss = _core.UncertaintyLoss(_core.loss_preset(name).config)
    curves = loss.curves(torch.linspace(raw_min, raw_max, _POINTS, dtype=torch.float64))
    return {**curves, "g": loss.config.lam * curves["g"]}


def _picture(figure: Figure) -> RgbImage:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def draw_curves(names: Sequence[str], raw_min: float = -6.0, raw_max: float = 6.0) -> RgbImage:
    """h, lam g and kappa over raw, one line for every distinct loss among `names`; RGB uint8.

    Raises:
        ValueError: for an unknown preset (with the nearest known one).
    """
    groups = {group[0]: ", ".join(group) for group in same_loss(list(names))}
    colors = _colors(list(groups))
    figure = Figure(figsize=(13.5, 5.2), dpi=80, layout="constrained")
    for axes, key in zip(figure.subplots(1, 3), _LABELS, strict=True):
        for name, label in groups.items():
            curves = _curves(name, raw_min, raw_max)
            axes.plot(curves["raw"], curves[key], color=colors[name], label=label, linewidth=1.5)
        axes.set_title(_LABELS[key], fontsize=11)
        axes.set_xlabel("raw", fontsize=9)
        axes.grid(alpha=0.3)
        if key != "g":
            axes.set_yscale("log")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return _picture(figure)


def draw_printed(names: Sequence[str], raw_min: float = -6.0, raw_max: float = 6.0) -> RgbImage:
    """kappa over raw of forms that the check refuses, with the place where it fails first; RGB uint8."""
    figure = Figure(figsize=(3.4 * len(names), 3.2), dpi=80, layout="constrained")
    for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        curves = _curves(name, raw_min, raw_max)
        kappa, h = curves["kappa"].clone(), curves["h"]
        kappa[kappa.abs() > 50] = torch.nan  # poles
        axes.plot(curves["raw"], kappa, color="C0", label="kappa")
        axes.plot(curves["raw"], h, color="C1", label="h")
        axes.axhline(0.0, color="0.6", linewidth=0.8)
        axes.set_ylim(-6, 6)
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("raw", fontsize=9)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, frameon=False)
    return _picture(figure)


def draw_minimum(name: str, errors: Sequence[float], raw_min: float = -6.0, raw_max: float = 6.0) -> RgbImage:
    """h E[f] + lam g over raw for several expected errors, each with the minimum that kappa predicts; RGB uint8."""
    curves = _curves(name, raw_min, raw_max)
    figure = Figure(figsize=(6.4, 4.0), dpi=80, layout="constrained")
    axes = figure.subplots()
    for index, error in enumerate(errors):
        value = curves["h"] * error + curves["g"]
        best = int((curves["kappa"] - error).abs().argmin())
        axes.plot(curves["raw"], value, color=f"C{index}", label=f"E[f] = {error:g}")
        axes.plot(curves["raw"][best], value[best], "o", color=f"C{index}")
    axes.set_ylim(top=float(curves["g"][-1]) + 2.0 * max(errors))
    axes.set_title(f"{name}: the loss over raw; dots: kappa(raw) = E[f]", fontsize=10)
    axes.set_xlabel("raw", fontsize=9)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, frameon=False)
    return _picture(figure)
