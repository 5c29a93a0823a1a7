# SPDX-License-Identifier: MIT
"""Scene presets in Python and YAML, mixes of them in training, and the contact sheets of the documentation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from ajna import synth
from ajna.cli import main
from ajna.data.scene_mix import MixedScenes, merge_scenes, scene_configs
from ajna.training.data import SyntheticData
from ajna.training.options import Stage, ValidationOptions

SMALL = {"bank_size": 4, "texture_size": 48}
ROOT = Path(__file__).resolve().parents[2]


def test_presets_are_scene_configs_with_options_over_them() -> None:
    names = list(synth.presets())
    assert names[0] == "general"
    assert {"chairs", "things", "dodge", "navigate", "gap", "pile", "photometric"} <= set(names)
    plain, general = synth.scene_config(), synth.scene_config({"preset": "general"})
    assert all(getattr(plain, name) == getattr(general, name) for name in synth.scene_options())
    forest = synth.scene_config({"preset": "navigate", "layers": 3})
    assert (forest.camera, forest.surface, forest.layers) == ("forward", "floor", 3)
    # The preset itself is not changed by that.
    assert synth.scene_config({"preset": "navigate"}).layers > 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "navigat"}, "did you mean 'navigate'"),
        ({"preset": 3}, "give a preset's name"),
        ({"preset": "gap", "camera": "sidewys"}, "did you mean 'sideways'"),
        ({"depth_near": 0.5, "depth_far": 0.4}, "depth_far"),
        ({"flat_texture_share": 0.8, "repetitive_texture_share": 0.3}, "repetitive_texture_share"),
    ],
)
def test_bad_presets_and_options_are_named(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        synth.scene_config(options)


def test_each_batch_of_a_mix_takes_one_preset_by_weight_and_seed() -> None:
    scenes = MixedScenes({**SMALL, "mix": {"dodge": 3.0, "gap": 1.0, "pile": 0.0}})
    assert list(scenes.generators) == ["dodge", "gap"]
    kinds = [scenes.kind_of(seed) for seed in range(2000)]
    assert abs(kinds.count("dodge") / 2000 - 0.75) < 0.04
    for seed in (1, 2, 3, 4):
        made = scenes(2, 24, 32, seed)
        own = synth.PairGenerator({**SMALL, "preset": scenes.kind_of(seed)})(2, 24, 32, seed)
        assert torch.equal(made.frame1, own.frame1)
        assert torch.equal(made.flow, own.flow)


def test_kinds_of_a_mix_share_their_textures() -> None:
    scenes = MixedScenes({**SMALL, "mix": {"general": 1, "dodge": 1, "photometric": 1}})
    general, dodge, photometric = (scenes.generators[k].textures for k in ("general", "dodge", "photometric"))
    assert torch.equal(general, dodge)
    assert not torch.equal(general, photometric)  # flat and repetitive ones
    with pytest.raises(ValueError, match="cannot share textures"):
        synth.PairGenerator({**SMALL, "preset": "photometric"}, share=scenes.generators["dodge"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mix": {"general": 1, "doge": 1}}, "did you mean 'dodge'"),
        ({"mix": {"general": -1}}, "weight of 0 or more"),
        ({"mix": {"general": True}}, "weight of 0 or more"),
        ({"mix": {"general": 0}}, "all weights are 0"),
        ({"mix": {}}, "give presets with weights"),
        ({"mix": {"general": 1}, "preset": "gap"}, "both given"),
        ({"mix": {"general": 1}, "layer": 3}, "did you mean 'layers'"),
    ],
)
def test_bad_mixes_are_named(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        scene_configs(options)


def test_a_stage_replaces_the_scenes_of_the_run() -> None:
    run = {"preset": "gap", "noise_max": 1.0}
    assert merge_scenes(run, {"mix": {"pile": 1}}) == {"noise_max": 1.0, "mix": {"pile": 1}}
    assert merge_scenes(run, {"layers": 2}) == {"preset": "gap", "noise_max": 1.0, "layers": 2}


def test_training_data_accept_presets_and_mixes() -> None:
    stages = [
        Stage(from_step=0, height=24, width=32, batch=2, scene={"preset": "dodge"}),
        Stage(from_step=3, height=24, width=32, batch=2, scene={"mix": {"gap": 1, "navigate": 1}}),
    ]
    validation = ValidationOptions(batches=1, batch=1, height=24, width=32, scene={"preset": "pile"})
    data = SyntheticData(stages, scene=dict(SMALL), validation=validation, prefetch=0)
    stream = iter(data.stream())
    batches = [next(stream) for _ in range(6)]
    assert all(batch["frame1"].shape == (2, 3, 24, 32) for batch in batches)
    assert data.generator(stages[0]).config.layers == synth.scene_config({"preset": "dodge"}).layers
    assert len(data.validation_batches()) == 1
    # A stream that starts in the middle sees the same samples.
    resumed = next(iter(data.stream(start=4)))
    assert torch.equal(resumed["frame1"], batches[4]["frame1"])
    with pytest.raises(ValueError, match="did you mean 'dodge'"):
        SyntheticData([Stage(0, 24, 32, 2, scene={"preset": "doge"})])


def test_preview_writes_a_contact_sheet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sheets" / "gap.png"
    arguments = [
        "synth",
        "preview",
        "--preset",
        "gap",
        "--columns",
        "2",
        "--size",
        "40x32",
        "--out",
        str(out),
        "--json",
    ]
    assert main(arguments) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["preset"] == "gap"
    assert summary["mean_flow_px"] > 0
    with Image.open(out) as opened:
        picture = np.asarray(opened.convert("RGB")).astype(int)
    assert picture.shape[0] > 5 * 32
    assert picture.shape[1] > 2 * 40
    assert [path.name for path in out.parent.iterdir()] == ["gap.png"]
    # The first row shows the frames that the generator makes.
    pairs = synth.PairGenerator({"preset": "gap"}, bank_seed=1)(2, 32, 40, 1)
    frame = pairs.frame1[1].permute(1, 2, 0).numpy().astype(int)
    right = picture[3 : 3 + 32, -43:-3]
    assert np.array_equal(right, frame)


def test_preview_refuses_in_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (["--preset", "gapp", "--out", str(tmp_path / "a.png")], "did you mean 'gap'"),
        (["--out", str(tmp_path / "a.jpg")], "not a .png"),
        (["--out", str(tmp_path / "a.png"), "--size", "12"], "WIDTHxHEIGHT"),
    ):
        assert main(["synth", "preview", *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_presets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["synth", "presets"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in synth.presets())


def test_every_preset_is_documented_with_its_sheet() -> None:
    page = (ROOT / "docs" / "scenes.md").read_text()
    for name in synth.presets():
        sheet = ROOT / "docs" / "images" / f"synth_{name}.png"
        assert f"images/{sheet.name}" in page, name
        assert sheet.stat().st_size <= 200_000, name
    for option in synth.augment_options():
        assert f"`{option}`" in page, option


def homography_of(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Least squares by the direct linear transformation, from [N, 2] to [N, 2]."""
    one, zero = np.ones((len(start), 1)), np.zeros((len(start), 3))
    ray = np.hstack([start, one])
    rows = np.vstack(
        [np.hstack([ray, zero, -end[:, :1] * ray]), np.hstack([zero, ray, -end[:, 1:] * ray])]
    )  # fmt: skip
    return np.linalg.svd(rows)[2][-1].reshape(3, 3)


def test_in_aligned_scenes_the_largest_plane_holds_still() -> None:
    options = {**SMALL, "preset": "gap", "static_probability": 0.0}
    seed, size = 3, (4, 60, 80)
    moving = synth.PairGenerator(options)(*size, seed)
    still = synth.PairGenerator({**options, "aligned_probability": 1.0})(*size, seed)
    assert torch.equal(moving.layer1, still.layer1)
    grid = np.stack(np.meshgrid(np.arange(80.0), np.arange(60.0)), axis=-1)
    for layer, before, after in zip(moving.layer1[:, 0].numpy(), moving.flow, still.flow, strict=True):
        plate = layer == layer.max()
        ends = grid + before.permute(1, 2, 0).numpy()
        kept = after.permute(1, 2, 0).numpy()
        assert np.abs(kept[plate]).max() < 1e-3 < np.abs(ends - grid)[plate].max()
        # What else moves does so relative to the plate: the plate's homography leads to where it was seen before.
        homography = homography_of(grid[plate], ends[plate])
        there = np.concatenate([grid + kept, np.ones((60, 80, 1))], axis=-1) @ homography.T
        assert np.allclose(there[..., :2] / there[..., 2:], ends, atol=0.02)
    assert not any(map(np.any, map(np.isnan, still.flow.numpy())))


def test_without_a_plate_the_background_holds_still_in_a_share_of_the_scenes() -> None:
    scenes = synth.PairGenerator({**SMALL, "preset": "pile", "aligned_probability": 0.5})(32, 24, 32, 7)
    ground = torch.where(scenes.layer1[:, 0] == 0, scenes.flow.abs().amax(1), 0.0).amax((1, 2))
    assert 8 <= int((ground < 1e-3).sum()) <= 24
    with pytest.raises(ValueError, match="aligned_probability"):
        synth.scene_config({"aligned_probability": 1.5})
