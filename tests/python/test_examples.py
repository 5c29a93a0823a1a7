# SPDX-License-Identifier: MIT
"""The losses on other networks: a few seconds of training each, enough to see learning and where it is uncertain."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

pytest.importorskip("torchmetrics", reason="needs the eval extra")

from ajna.examples import depth, disparity, harness, normals, scenes, segmentation

STEPS = 100
EXAMPLES = [depth.Depth, disparity.Disparity, normals.Normals, segmentation.Segmentation]
examples = pytest.mark.parametrize("kind", EXAMPLES, ids=lambda kind: kind.name)


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def view() -> scenes.View:
    return scenes.render(scenes.random_scenes(4, torch.Generator().manual_seed(5)), 48, 64, 64.0)


def test_scenes_are_consistent(view: scenes.View) -> None:
    assert all(x.isfinite().all() for x in (view.image, view.depth, view.normal, view.point))
    assert view.image.min() >= 0 and view.image.max() <= 1
    assert (view.normal.norm(dim=1) - 1).abs().max() < 1e-4
    rays = scenes._rays(48, 64, 64.0).T.reshape(1, 3, 48, 64)
    assert torch.allclose(view.point, view.depth * rays, atol=1e-4)
    assert ((view.normal * rays).sum(1) < 1e-3).all(), "visible surfaces face the camera"
    # The normal is that of the surface: inside of one surface, neighbours on a plane lie in it.
    floor = (view.surface == scenes.FLOOR)[:, 0]
    assert torch.allclose(view.point[:, 1][floor], torch.ones(int(floor.sum())), atol=1e-3)
    wall = (view.surface == scenes.WALL)[:, 0, :, 1:] & (view.surface == scenes.WALL)[:, 0, :, :-1]
    step = view.point[..., 1:] - view.point[..., :-1]
    assert (step * view.normal[..., 1:]).sum(1)[wall].abs().max() < 1e-3


def test_a_shifted_camera_sees_the_same_points() -> None:
    """Eq. 23: what is at x in the left image is at x - b f / Z in the right one, unless it is hidden there."""
    world = scenes.random_scenes(2, torch.Generator().manual_seed(6))
    example = disparity.Disparity()
    views = [scenes.render(world, 64, 80, 80.0, shift_m=shift) for shift in (0.0, example.base_m)]
    shift = example.base_m * example.focal_px / views[0].depth
    hidden = example.hidden(*views, shift)
    columns = (torch.arange(80) - shift).round().long().clamp(0, 79)
    matched = views[1].point.gather(3, columns.expand(-1, 3, -1, -1))
    distance = (matched - views[0].point).norm(dim=1, keepdim=True)
    calm = ~scenes.spread(hidden | scenes.object_boundary(views[0].surface), 2)
    assert distance[calm].median() < 0.05 and distance[hidden].median() > 0.2
    assert 0.02 < hidden.float().mean() < 0.5


@examples
def test_learns_and_is_uncertain_in_the_right_places(kind: type[harness.Example]) -> None:
    example = kind()
    report, found = harness.run(example, STEPS, seed=0, scenes=8)
    _, start = harness.run(example, 1, seed=0, scenes=8)
    assert report.error < 0.9 * float(start.error.mean())
    assert found.expected.isfinite().all() and (found.expected > 0).all()
    for region in report.regions:
        if kind is not depth.Depth:  # one image tells little of depth: it takes the program's 500 steps
            assert region.auc > 0.55, report.text()
    picture = harness.draw(example, found, scenes=2)
    assert picture.dtype == np.uint8 and picture.std() > 10


def test_equal_seeds_give_equal_networks() -> None:
    outputs = [harness.train(depth.Depth(), 2, seed=3)(torch.ones(1, 3, 16, 16)) for _ in range(2)]
    assert torch.equal(*outputs)


def test_the_temperature_is_the_attenuation() -> None:
    example = segmentation.Segmentation()
    logits, raw = torch.randn(1, 4, 2, 2), torch.tensor([-3.0, 0.0, 2.0, 6.0]).view(1, 1, 2, 2)
    probabilities = example.probabilities(logits, raw)
    assert torch.allclose(probabilities.sum(1), torch.ones(1, 2, 2))
    by_hand: Tensor = torch.softmax(logits[..., 1, 1] / torch.nn.functional.softplus(torch.tensor(6.001)), 1)
    assert torch.allclose(probabilities[..., 1, 1], by_hand, atol=1e-6)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--steps", "2", "--out", str(tmp_path / "out"), "--json"]
    assert harness.main(depth.Depth(), arguments) == 1  # two steps teach nothing, and it says so
    record = json.loads(capsys.readouterr().out)
    assert not record["holds"] and record["steps"] == 2 and "depth boundary" in record["regions"]
    assert np.asarray(Image.open(tmp_path / "out" / "depth.png")).shape[2] == 3
    assert harness.main(depth.Depth(), ["--steps", "0"]) == 2
    assert "steps" in capsys.readouterr().err
