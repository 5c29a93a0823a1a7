# SPDX-License-Identifier: MIT
"""The Python face of the synthetic scenes: options, photographs, and the identity that defines flow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from ajna import synth

SMALL = {"bank_size": 6, "texture_size": 64}


def test_options_come_from_the_core_and_every_one_can_be_set() -> None:
    options = synth.scene_options()
    assert {"layers", "flow_mean_px", "flow_distribution", "noise_max", "photo_probability"} <= set(options)
    config = synth.scene_config({**options, "flow_mean_px": 7.5, "layers": 3})
    assert config.flow_mean_px == 7.5
    assert config.layers == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"flow_mean": 3.0}, "did you mean 'flow_mean_px'"),
        ({"layers": 99}, "layers = 99"),
        ({"layers": "six"}, "layers"),
        ({"flow_distribution": "uniforn"}, "did you mean 'uniform'"),
        ({"noise_max": float("nan")}, "noise_max"),
    ],
)
def test_bad_options_are_named(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        synth.scene_config(options)


def test_pairs_satisfy_the_warp_identity() -> None:
    changes = ("blur_probability", "defocus_probability", "noise_max", "brightness_change", "color_change")
    clean = {**dict.fromkeys(changes, 0.0), "gamma_change": 0.0}
    generator = synth.PairGenerator({**SMALL, **clean}, bank_seed=2)
    pairs = generator(6, 64, 96, seed=3)
    v, u = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    grid = torch.stack([(u + pairs.flow[:, 0]) * 2 / 95 - 1, (v + pairs.flow[:, 1]) * 2 / 63 - 1], -1)
    warped = torch.nn.functional.grid_sample(pairs.frame2.float(), grid, align_corners=True)
    visible = ~(pairs.occlusion | pairs.motion_boundary)
    error = (warped - pairs.frame1.float()).abs().mean(1, keepdim=True)
    assert error[visible].median() < 1.0


def test_photographs_become_textures(tmp_path: Path) -> None:
    colour = np.zeros((80, 120, 3), np.uint8)
    colour[..., 0] = 200
    Image.fromarray(colour).save(tmp_path / "red.png")
    photos = synth.load_photos(tmp_path, count=3, size=64, seed=1)
    assert photos.shape == (3, 3, 64, 64)
    assert photos.dtype == torch.uint8
    assert (photos[:, 0] == 200).all()
    generator = synth.PairGenerator(SMALL, photos=photos)
    assert generator.textures.shape == (9, 3, 64, 64)
    assert torch.allclose(generator.textures[-1, 0], torch.tensor(200 / 255))


def test_bad_photograph_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="absent"):
        synth.load_photos(tmp_path / "absent", 1, 32)
    with pytest.raises(ValueError, match="holds no"):
        synth.load_photos(tmp_path, 1, 32)
    (tmp_path / "broken.jpg").write_text("not a picture")
    with pytest.raises(ValueError, match=r"broken\.jpg"):
        synth.load_photos(tmp_path, 1, 32)
    with pytest.raises(ValueError, match="photographs of shape"):
        synth.PairGenerator(SMALL, photos=torch.zeros(1, 3, 8, 8, dtype=torch.uint8))
