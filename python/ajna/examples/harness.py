# SPDX-License-Identifier: MIT
"""What the four examples share: training, measuring on fresh scenes, the picture and the command line."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
import torch
import typer
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor, nn

from ajna import viz
from ajna.cli import errors
from ajna.cli.options import JsonOption
from ajna.cli.outputs import check_folder, staged_folder
from ajna.examples.unet import UNet
from ajna.losses import UncertaintyLoss
from ajna.metrics import pearson_correlation, roc_auc

RgbImage = NDArray[np.uint8]

#: What must hold of every region.
MIN_RATIO, MIN_AUC = 1.3, 0.7


@dataclass
class Batch:
    """Generated training or test data."""

    inputs: Tensor  # float32 [N, C, H, W]
    target: Tensor  # what the loss takes as target
    picture: Tensor  # float32 [N, 3, H, W], 0 to 1: the input for people
    #: name -> (where the uncertainty should be high, where low), bool [N, 1, H, W]
    regions: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)


class Example(Protocol):
    """A quantity, its data and its loss."""

    name: str
    unit: str  # of f
    inputs: int
    outputs: int  # without the raw uncertainty
    loss: UncertaintyLoss
    height: int
    width: int

    def batch(self, count: int, generator: torch.Generator) -> Batch:
        """`count` fresh scenes."""

    def prediction(self, output: Tensor) -> Tensor:
        """The network's first channels -> what the loss takes as prediction."""

    def baseline(self, batch: Batch) -> Tensor:
        """f of the best constant prediction, [N, 1, H, W]: what any learning must beat."""

    def rgb(self, prediction: Tensor, target: Tensor) -> tuple[RgbImage, RgbImage]:
        """One scene's prediction and target [C, H, W] as pictures uint8 [H, W, 3]."""


@dataclass
class Region:
    """One statement of where the uncertainty is high."""

    name: str
    ratio: float  # median expected error there over the median elsewhere
    auc: float  # probability that a pixel there has a larger one than a pixel elsewhere

    @property
    def holds(self) -> bool:
        """Whether the uncertainty tells the two apart: a clearly higher median, and an AUC above 0.7."""
        return self.ratio > MIN_RATIO and self.auc > MIN_AUC


@dataclass
class Report:
    """What was measured on fresh scenes; errors are means of f in its unit."""

    name: str
    unit: str
    loss: str
    steps: int
    seconds: float
    error: float
    baseline: float  # of the best constant
    expected: float  # mean of kappa(raw)
    rho: float  # Pearson correlation of expected and actual error over pixels
    regions: list[Region]

    @property
    def holds(self) -> bool:
        """Whether the network has learnt (error below 60 % of a constant's) and every region's claim holds."""
        return self.error < 0.6 * self.baseline and all(region.holds for region in self.regions)

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        regions = {region.name: {"ratio": region.ratio, "auc": region.auc} for region in self.regions}
        names = ("name", "unit", "loss", "steps", "seconds", "error", "baseline", "expected", "rho", "holds")
        return {**{name: getattr(self, name) for name in names}, "regions": regions}

    def text(self) -> str:
        """A few lines for people."""
        lines = [
            f"{self.name}: {self.loss}",
            f"  {self.steps} steps in {self.seconds:.0f} s; mean error {self.error:.3g} {self.unit} "
            f"(best constant: {self.baseline:.3g}), expected {self.expected:.3g}, correlation {self.rho:.2f}",
        ]
        for region in self.regions:
            verdict = "" if region.holds else f"  FAILS (ratio above {MIN_RATIO} and AUC above {MIN_AUC} expected)"
            lines.append(f"  {region.name}: {region.ratio:.1f} times the median, AUC {region.auc:.3f}{verdict}")
        return "\n".join(lines)


def train(example: Example, steps: int, seed: int, batch_size: int = 4, lr: float = 4e-3) -> nn.Module:
    """A network trained on fresh scenes in every step; equal seeds give equal networks."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    network = UNet(example.inputs, example.outputs + 1)
    optimizer = torch.optim.AdamW(network.parameters(), lr=lr, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=lr, total_steps=steps + 1, pct_start=0.15)
    for _ in range(steps):
        batch = example.batch(batch_size, generator)
        output = network(batch.inputs)
        loss = example.loss(example.prediction(output[:, :-1]), output[:, -1:], batch.target)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return network.eval()


@dataclass
class Answer:
    """A trained network on a batch."""

    batch: Batch
    prediction: Tensor
    raw: Tensor  # [N, 1, H, W]
    error: Tensor  # f, [N, 1, H, W]
    expected: Tensor  # kappa(raw), [N, 1, H, W]


def answer(example: Example, network: nn.Module, count: int, seed: int) -> Answer:
    """The network's word on `count` scenes that it has not seen."""
    batch = example.batch(count, torch.Generator().manual_seed(seed))
    with torch.no_grad():
        output = network(batch.inputs)
        prediction, raw = example.prediction(output[:, :-1]), output[:, -1:]
        error = example.loss.error(prediction, batch.target)
        return Answer(batch, prediction, raw, error, example.loss.expected_error(raw))


def measure(example: Example, found: Answer, steps: int, seconds: float) -> Report:
    """The figures of a report, over all pixels of a batch."""
    regions = []
    for name, (high, low) in found.batch.regions.items():
        there, elsewhere = found.expected[high], found.expected[low]
        score = torch.cat([there, elsewhere])
        positive = torch.cat([torch.ones_like(there), torch.zeros_like(elsewhere)]) > 0.5
        ratio = float(there.median() / elsewhere.median())
        regions.append(Region(name, ratio, float(roc_auc(score, positive))))
    return Report(
        name=example.name,
        unit=example.unit,
        loss=example.loss.describe(),
        steps=steps,
        seconds=seconds,
        error=float(found.error.mean()),
        baseline=float(example.baseline(found.batch).mean()),
        expected=float(found.expected.mean()),
        rho=float(pearson_correlation(found.expected.flatten(), found.error.flatten())),
        regions=regions,
    )


def draw(example: Example, found: Answer, scenes: int = 3) -> RgbImage:
    """Scenes in rows: input, prediction, truth, and in one colour scale the actual and the expected error."""
    batch, scale = found.batch, viz.robust_scale(found.error[:scenes].numpy(), found.expected[:scenes].numpy())
    titles = ["input", "prediction", "truth", f"actual error, 0 to {scale:g} {example.unit}", "expected error"]
    size_x, size_y, dpi, head = 2.1, 2.1 * example.height / example.width, 100, 0.25
    figure = Figure(figsize=(len(titles) * size_x, scenes * size_y + head), dpi=dpi, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    grid = figure.subplots(scenes, len(titles), squeeze=False)
    figure.subplots_adjust(0.005, 0.01, 0.995, 1 - head / (scenes * size_y + head), wspace=0.03, hspace=0.04)
    for row, axes in enumerate(grid):
        picture = np.rint(255 * batch.picture[row].permute(1, 2, 0).numpy()).astype(np.uint8)
        images = [picture, *example.rgb(found.prediction[row], batch.target[row])]
        images += [viz.uncertainty_to_image(x[row, 0].numpy(), 0.0, scale) for x in (found.error, found.expected)]
        for panel, image, title in zip(axes, images, titles, strict=True):
            panel.imshow(image, interpolation="nearest")
            panel.set_axis_off()
            if row == 0:
                panel.set_title(title, fontsize=9, pad=4)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def run(example: Example, steps: int, seed: int, scenes: int = 32) -> tuple[Report, Answer]:
    """Train, then measure on fresh scenes.

    Raises:
        ValueError: for less than one step.
    """
    if steps < 1:
        raise ValueError(f"example option steps = {steps}: give at least 1")
    start = time.perf_counter()
    network = train(example, steps, seed)
    seconds = time.perf_counter() - start
    found = answer(example, network, scenes, seed + 1_000_000)
    return measure(example, found, steps, seconds), found


def main(example: Example, argv: list[str] | None = None, steps: int = 500) -> int:
    """The command line of an example: train, print the report, write a picture; exit code 1 where a claim fails."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

    @app.command(help=f"Train a small network for {example.name} on generated scenes and check its uncertainty.")
    def command(
        out: Annotated[Path | None, typer.Option(help="Folder for the picture and the figures.")] = None,
        steps: Annotated[int, typer.Option(min=1, help="Training steps.")] = steps,
        seed: Annotated[int, typer.Option(min=0, help="Seed of scenes and weights.")] = 0,
        as_json: JsonOption = False,
    ) -> None:
        if out is not None:
            check_folder(out)
        report, found = run(example, steps, seed)
        text = json.dumps(report.record(), indent=2)
        if out is not None:
            with staged_folder(out) as stage:
                Image.fromarray(draw(example, found)).save(stage / f"{example.name}.png")
                (stage / f"{example.name}.json").write_text(text + "\n")
        typer.echo(text if as_json else report.text())
        if not report.holds:
            raise typer.Exit(1)

    return errors.run(app, argv)
