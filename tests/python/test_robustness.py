# SPDX-License-Identifier: MIT
"""The robustness study: disturbances, figures of a known field, a patch that attacks, the command."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("cv2")
pytest.importorskip("torchmetrics")

from ajna import losses, nn
from ajna.cli import main
from ajna.studies.disturbances import DISTURBANCES, Patch, disturbed, make_scene, with_patch
from ajna.studies.patch_attack import AttackOptions, random_patch, train_patch
from ajna.studies.robustness import Condition, RobustnessOptions, measure, run

SIZE = {"width": 96, "height": 80}


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def scene():
    return make_scene(2, 7, **SIZE)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small network with random weights."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("net") / "tiny.safetensors"
    nn.save_checkpoint(path, nn.FlowNet(width=8), "tiny", losses.preset("ajna2023"), flow_scale=8.0)
    return path


def test_scenes_have_textures_of_their_own() -> None:
    first, again, other = make_scene(2, 7, **SIZE), make_scene(2, 7, **SIZE), make_scene(5, 7, **SIZE)
    assert np.array_equal(first.frame1, again.frame1)
    assert not np.array_equal(first.frame1, other.frame1)
    assert first.boundary.sum() >= 150


@pytest.mark.parametrize("name", list(DISTURBANCES))
def test_disturbances(scene, name: str) -> None:
    pair = disturbed(scene, name, 1)
    assert np.array_equal(pair.frame2, disturbed(scene, name, 1).frame2)
    assert np.array_equal(pair.boundary, scene.boundary)
    changed = np.abs(pair.frame2.astype(int) - scene.frame2).max(axis=2)
    if name == "clean":
        assert pair is scene
    elif name == "still":
        assert np.array_equal(pair.frame1, pair.frame2) and not pair.occluded.any()
    elif name.startswith("lamp"):
        before = pair.frame1 if name == "lamp, still" else scene.frame2
        lit = np.abs(pair.frame2.astype(int) - before).max(axis=2)
        assert lit[pair.touched].max() > 60 and lit[~pair.touched].max() == 0
        assert 0.003 < pair.touched.mean() < 0.15
    elif name == "low texture":
        inner = scene.layer1 == scene.layer1[40, 48]
        assert pair.frame1[inner].std(axis=0).max() < 0.2 * scene.frame1[inner].std(axis=0).max() + 1
    elif name == "blur":
        step = [np.abs(np.diff(f.astype(float), axis=1)).mean() for f in (scene.frame1, pair.frame1)]
        assert step[1] < 0.7 * step[0]
    else:
        assert np.median(changed) > 3 if name != "rain" else changed.max() > 30


def test_figures_of_a_known_field(scene) -> None:
    """Uncertainty 3 at boundaries and 1 elsewhere is told apart without error; equal uncertainty is not."""
    from ajna.analysis import distance_to

    at = distance_to(scene.boundary, 4) <= 2
    uncertainty = np.where(at, 3.0, 1.0)[..., None] * np.array([1.0, 0.0])
    field = SimpleNamespace(uncertainty=uncertainty, flow=np.zeros((*at.shape, 2)))
    moved = SimpleNamespace(flow=np.full((*at.shape, 2), [3.0, 4.0]))
    figures = measure(scene, field, scene, moved)
    assert figures.boundary == pytest.approx(3.0) and figures.auc == pytest.approx(1.0)
    assert figures.change_px == pytest.approx(5.0)
    level = SimpleNamespace(uncertainty=np.ones((*at.shape, 2)), flow=field.flow)
    assert measure(scene, level, scene, level).auc == pytest.approx(0.5)
    condition = Condition("known", [figures, figures])
    record = condition.record()
    known = [key for key in ("over_flat", "over_textured") if record[key] is not None]
    assert known and all(record[key] == pytest.approx(3.0) for key in known)
    assert record["over_touched"] is None
    assert record["px_over_flat"] is None, "a model without calibration has no error in pixels"


def test_ratio_in_pixels_of_a_calibrated_field(scene) -> None:
    """The uncertainty may be the root of the expected error: the ratio in pixels is then its square."""
    from dataclasses import replace

    from ajna.analysis import distance_to

    bare = replace(scene, frame1=np.full_like(scene.frame1, 90))
    at = distance_to(scene.boundary, 4) <= 2
    root = np.where(at, 3.0, 1.0)[..., None] * np.array([1.0, 0.0])
    field = SimpleNamespace(uncertainty=root, expected_error=root**2, flow=np.zeros((*at.shape, 2)))
    record = Condition("known", [measure(bare, field, bare, field)] * 2).record()
    assert record["over_flat"] == pytest.approx(3.0)
    assert record["px_over_flat"] == pytest.approx(9.0) and record["boundary_px"] == pytest.approx(9.0)


def test_patch_lies_in_both_frames_and_hides_boundaries(scene) -> None:
    pair = with_patch(scene, random_patch(24), 3)
    x, y = random_patch(24).place(scene, 3)
    box = np.s_[y : y + 24, x : x + 24]
    assert np.array_equal(pair.frame1[box], pair.frame2[box])
    assert pair.touched[box].all() and pair.touched.sum() == 24 * 24
    assert not pair.boundary[box].any()


def test_attack_changes_the_flow_more_than_it_did_at_first(scene, checkpoint: Path) -> None:
    options = AttackOptions(side=24, steps=25, batch=1)
    net, metadata = nn.load_checkpoint(checkpoint)

    def change(patch: Patch) -> float:
        pair = with_patch(scene, patch, 0)
        flows = []
        for shown in (scene, pair):
            frames = [torch.from_numpy(f).permute(2, 0, 1)[None] for f in (shown.frame1, shown.frame2)]
            with torch.no_grad():
                flows.append(metadata["flow_scale"] * net(nn.network_input(*frames))[0, :2])
        outside = torch.from_numpy(~pair.touched)
        return float((flows[1] - flows[0]).norm(dim=0)[outside].mean())

    trained = train_patch(checkpoint, [scene], options)
    assert trained.side == 24
    assert change(trained) > 1.2 * change(random_patch(24))
    with pytest.raises(ValueError, match="scenes"):
        train_patch(checkpoint, [], options)
    with pytest.raises(ValueError, match="side of at least 4"):
        AttackOptions(side=2)


def test_unknown_disturbance_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown disturbance 'fog'"):
        run(None, RobustnessOptions(scenes=2, **SIZE), names=["fog"])
    with pytest.raises(ValueError, match="at least"):
        RobustnessOptions(scenes=1)


def test_command(tmp_path: Path, checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["study", "robustness", "--model", str(checkpoint), "--scenes", "2", "--patch-steps", "1"]
    out = tmp_path / "out"
    assert main([*arguments, "--size", "96x80", "--surrogate", str(checkpoint), "--out", str(out), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    names = [condition["name"] for condition in record["conditions"]]
    assert names == [*DISTURBANCES, "patch, random", "patch, white box", "patch, transferred"]
    assert record == json.loads((out / "robustness.json").read_text())
    page = (out / "robustness.md").read_text()
    assert all(f"| {name}" in page for name in names)
    assert {p.name for p in (out / "images").iterdir()} == {"robustness.png", "robustness_examples.jpg"}
    assert main([*arguments, "--surrogate", str(tmp_path / "none.safetensors")]) == 2
    assert "Traceback" not in capsys.readouterr().err
