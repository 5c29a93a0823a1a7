# SPDX-License-Identifier: MIT
"""The Python face of augmentation; what it does to flow and masks is tested in C++."""

from __future__ import annotations

import pytest
import torch

from ajna import synth


def batch(count: int = 3, height: int = 48, width: int = 64) -> dict[str, torch.Tensor]:
    pairs = synth.PairGenerator({"bank_size": 4, "texture_size": 48}, bank_seed=2)(count, height, width, seed=3)
    names = ("frame1", "frame2", "flow", "occlusion", "motion_boundary")
    return {name: getattr(pairs, name) for name in names}


def test_options_come_from_the_core_and_every_one_can_be_set() -> None:
    options = synth.augment_options()
    assert {"brightness", "contrast", "hue", "saturation", "gamma", "noise", "rotation_deg"} <= set(options)
    config = synth.augment_config({**options, "hue": 0.25, "patch_count": 3})
    assert (config.hue, config.patch_count) == (0.25, 3)
    authors = synth.augment_config({"preset": "authors"})
    assert authors.brightness == pytest.approx(20 / 255)
    assert (authors.contrast, authors.hue, authors.saturation, authors.gamma) == (0.5, 0.5, 0.5, 0.1)
    assert authors.asymmetric_probability == 1
    assert authors.rotation_deg == 0 or authors.spatial_probability == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rotation_degs": 3.0}, "did you mean 'rotation_deg'"),
        ({"hue": 0.9}, "hue = 0.9"),
        ({"patch_count": "two"}, "type int"),
        ({"preset": "auhors"}, "did you mean 'authors'"),
        ({"scale_min": 1.0, "scale_max": 0.0}, "scale_max"),
    ],
)
def test_bad_options_are_named(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        synth.Augmenter(options)


def test_the_same_keys_come_back_at_the_size_of_the_crop() -> None:
    given = {**batch(), "step": 7}
    made = synth.Augmenter()(given, 32, 40, seed=5)
    assert set(made) == {*given, "valid"}
    assert made["step"] == 7
    for name in ("frame1", "frame2", "flow", "occlusion", "motion_boundary"):
        assert made[name].shape == (*given[name].shape[:2], 32, 40)
        assert made[name].dtype == given[name].dtype
    assert made["valid"].dtype == torch.bool
    again = synth.Augmenter()(given, 32, 40, seed=5)
    assert all(torch.equal(made[name], again[name]) for name in made if name != "step")
    other = synth.Augmenter()(given, 32, 40, seed=6)
    assert not torch.equal(made["frame1"], other["frame1"])


def test_augmented_scenes_satisfy_the_warp_identity() -> None:
    changes = ("blur_probability", "defocus_probability", "noise_max", "brightness_change", "color_change")
    clean = {**dict.fromkeys(changes, 0.0), "gamma_change": 0.0}
    pairs = synth.PairGenerator({"bank_size": 6, "texture_size": 64, **clean}, bank_seed=2)(8, 80, 112, seed=3)
    names = ("frame1", "frame2", "flow", "occlusion", "motion_boundary")
    given = {name: getattr(pairs, name) for name in names}
    geometric = {"color_probability": 0.0, "blur_probability": 0.0, "patch_probability": 0.0}
    made = synth.Augmenter(geometric)(given, 64, 96, seed=1)
    v, u = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    grid = torch.stack([(u + made["flow"][:, 0]) * 2 / 95 - 1, (v + made["flow"][:, 1]) * 2 / 63 - 1], -1)
    warped = torch.nn.functional.grid_sample(made["frame2"].float(), grid, align_corners=True)
    visible = made["valid"] & ~(made["occlusion"] | made["motion_boundary"])
    error = (warped - made["frame1"].float()).abs().mean(1, keepdim=True)
    assert visible.float().mean() > 0.3
    assert error[visible].median() < 2.0


def test_unknown_tensors_and_shapes_are_named() -> None:
    given = batch()
    with pytest.raises(ValueError, match="did you mean 'occlusion'"):
        synth.Augmenter()({**given, "oclusion": given["occlusion"]}, 16, 16, 1)
    with pytest.raises(ValueError, match="flow is"):
        synth.Augmenter()({**given, "flow": given["flow"].double()}, 16, 16, 1)
    with pytest.raises(ValueError, match="swap_probability"):
        synth.Augmenter({"swap_probability": 0.5})(given, 16, 16, 1)
    with pytest.raises(ValueError, match="give all three"):
        synth.Augmenter()({"frame1": given["frame1"]}, 16, 16, 1)
