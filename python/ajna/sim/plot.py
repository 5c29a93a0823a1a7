# SPDX-License-Identifier: MIT
"""Plan views of the paths flown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ajna.sim.episode import EpisodeResult
from ajna.sim.worlds import DodgeSetup, World

__all__ = ["plan_view"]


def plan_view(world: World, results: Mapping[str, Sequence[EpisodeResult]]) -> Any:
    """A matplotlib Figure: the world from above with the path of each method's trial in it (x to the right).

    Args:
        results: by the label of the method; trials of other seeds than the world's are left out.
    """
    from matplotlib.figure import Figure

    x_min, x_max, y_min, y_max = world.bounds
    figure = Figure(figsize=(9, max(2.6, 9 * (y_max - y_min) / (x_max - x_min) + 0.9)), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    for outline in world.outlines:
        axes.fill(outline.points[:, 0], outline.points[:, 1], color="0.72", edgecolor="0.4", linewidth=0.6)
    if isinstance(world.setup, DodgeSetup):
        setup = world.setup
        end = setup.position + setup.velocity * setup.flight_s
        axes.annotate(
            "", tuple(end[:2]), tuple(setup.position[:2]), arrowprops={"arrowstyle": "->", "color": "tab:red"}
        )
    for label, trials in results.items():
        for trial in trials:
            if trial.seed == world.seed and trial.path:
                path = np.array(trial.path)
                (line,) = axes.plot(path[:, 1], path[:, 2], linewidth=1.5, label=f"{label}: {trial.reason}")
                mark = "o" if trial.success else "x"
                axes.plot(path[-1, 1], path[-1, 2], mark, color=line.get_color(), markersize=6)
    axes.set(xlim=(x_min, x_max), ylim=(y_min, y_max), xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_title(f"{world.name}, seed {world.seed}", fontsize=10)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=8, loc="upper right")
    return figure
