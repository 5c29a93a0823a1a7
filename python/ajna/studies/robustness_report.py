# SPDX-License-Identifier: MIT
"""The robustness study's page and pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ajna import viz
from ajna.analysis import AT_PX, AWAY_PX, FLAT_GREY
from ajna.studies.disturbances import DISTURBANCES, Patch, disturbed, make_scene, with_patch
from ajna.studies.robustness import RobustnessOptions, RobustnessStudy

__all__ = ["draw", "examples", "markdown"]

RgbImage = NDArray[np.uint8]

_WHAT = {
    "clean": "nothing",
    "still": "nothing moves: both frames are equal",
    "lamp, still": "a lamp goes on, nothing moves",
    "lamp, moving": "a lamp goes on, the scene moves",
    "low texture": "contrast within surfaces at a tenth",
    "brightness jump": "exposure of the second frame doubled or halved",
    "noise": "Gaussian noise, 15 grey levels",
    "blur": "out of focus, Gaussian of 2.5 px",
    "rain": "250 to 400 streaks in each frame",
}


def _interval(record: dict[str, Any], key: str, scale: float = 1.0, digits: int = 2) -> str:
    if record[key] is None:
        return "–"
    low, high = record[f"{key}_ci"]
    return f"{scale * record[key]:.{digits}f} [{scale * low:.{digits}f}, {scale * high:.{digits}f}]"


def markdown(study: RobustnessStudy, figures: str, pictures: str) -> str:
    """The study as a page; ``figures`` and ``pictures``: paths of the plot and of the examples, seen from there."""
    records = [condition.record() for condition in study.conditions]
    options = study.options
    lines = [
        "# What disturbs the uncertainty",
        "",
        "This page is written by `ajna study robustness --out docs`; its figures are that run's (model "
        f"{study.model}, {options.scenes} scenes of {options.width}x{options.height} px, seed {options.seed}, "
        f"{study.seconds:.0f} s).",
        "",
        "The claim: uncertainty at depth boundaries is almost always far greater than in regions of low texture, "
        "whatever else happens in the picture. Scenes are gaps, static obstacles and moving objects in turn "
        "(`ajna synth presets`), each with a texture bank of its own, none of them seen in training; every "
        f"disturbance is applied to all. *Boundary*: within {AT_PX} px of a motion boundary; *flat*: local contrast "
        f"below {FLAT_GREY:.0f} grey levels, more than {AWAY_PX} px away from boundaries; *textured*: the rest that "
        "far away; *touched*: what the disturbance covers. Where nothing moves, boundaries are those of the moving "
        "scene: they should not stand out.",
        "",
        "Medians over scenes of the mean uncertainty in a region (2-norm over the axes); ratios, and the share of the "
        "scenes in which boundaries are the more uncertain; AUC: the probability that a pixel at a boundary is more "
        "uncertain than one away from it (mean over scenes). *In px*: the same ratio of the expected error, "
        "since the uncertainty itself goes about with the root of the error it stands for. 95 % bootstrap "
        "intervals over scenes.",
        "",
        "| disturbance | boundary | flat | textured | touched | boundary / flat | in px | "
        "boundary > flat, % | boundary / textured | boundary / touched | AUC | change of flow elsewhere, px |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for record in records:
        what = _WHAT.get(record["name"])
        title = record["name"] if what is None else f"{record['name']} ({what})"
        cells = [title]
        cells += ["–" if record[k] is None else f"{record[k]:.2f}" for k in ("boundary", "flat", "textured", "touched")]
        cells += [
            _interval(record, "over_flat"),
            _interval(record, "px_over_flat"),
            _interval(record, "above_flat_share", 100, 0),
            _interval(record, "over_textured"),
            _interval(record, "over_touched"),
            _interval(record, "auc"),
            _interval(record, "change_px"),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    counted = ", ".join(
        f"{record['name']} {record['scenes_with_flat']}" for record in records if record["scenes_with_flat"]
    )
    lines += ["", f"Scenes that have flat regions: {counted or 'none'}."]
    lines += [f"Not measured: {note}." for note in study.notes]
    lines += ["", f"![Boundary over flat and textured regions]({figures})", "", f"![Pairs and maps]({pictures})"]
    return "\n".join(lines) + "\n"


def draw(study: RobustnessStudy) -> RgbImage:
    """Boundary over flat, textured and touched regions: median, quartiles and 5 to 95 % of the scenes."""
    names = [condition.name for condition in study.conditions]
    figure = Figure(figsize=(10.5, 0.42 * len(names) + 1.8), dpi=90, facecolor="white", layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for axes, region in zip(figure.subplots(1, 3, sharey=True), ("flat", "textured", "touched"), strict=True):
        for row, condition in enumerate(study.conditions):
            ratio = condition.ratios(region)
            if ratio.size:
                low, first, median, third, high = np.quantile(ratio, [0.05, 0.25, 0.5, 0.75, 0.95])
                axes.plot([low, high], [row, row], color="0.4", linewidth=1)
                axes.plot([first, third], [row, row], color="C0", linewidth=7, solid_capstyle="butt")
                axes.plot(median, row, "|", color="C1", markersize=13, markeredgewidth=2)
        axes.axvline(1.0, color="0.5", linewidth=0.8)
        axes.set_xscale("log")
        axes.set_title(f"uncertainty at boundaries / {region}", fontsize=10)
        axes.tick_params(labelsize=8)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_formatter(lambda value, _: "")
        axes.set_xticks([0.25, 0.5, 1, 2, 4, 8])
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def examples(model: Any, options: RobustnessOptions, patches: dict[str, Patch], number: int = 0) -> RgbImage:
    """One scene under every disturbance: both frames and the uncertainty, on one scale, two disturbances a row."""
    scene = make_scene(number, options.seed, options.width, options.height)
    pairs = [(name, disturbed(scene, name, options.seed)) for name in DISTURBANCES]
    pairs += [(name, with_patch(scene, patch, options.seed)) for name, patch in patches.items()]
    fields = [model(pair.frame1, pair.frame2) for _, pair in pairs]
    calm = np.linalg.norm(fields[0].uncertainty, axis=2)
    scale = float(np.quantile(calm, 0.995))
    rows = -(-len(pairs) // 2)
    figure = Figure(figsize=(12.5, 1.75 * rows), dpi=80, facecolor="white", layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.subplots(rows, 6, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for index, ((name, pair), field) in enumerate(zip(pairs, fields, strict=True)):
        cells = grid[index // 2][3 * (index % 2) : 3 * (index % 2) + 3]
        maps = viz.uncertainty_to_image(np.linalg.norm(field.uncertainty, axis=2), 0.0, scale)
        for axes, picture in zip(cells, (pair.frame1, pair.frame2, maps), strict=True):
            axes.imshow(picture)
        cells[0].set_title(name, fontsize=9, loc="left")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
