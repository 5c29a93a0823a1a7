# SPDX-License-Identifier: MIT
"""UncertaintyLoss in Python: an ordinary module; its mathematics is tested in tests/cpp/test_loss.cpp."""

from __future__ import annotations

import copy
import itertools
import math
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from ajna import _core
from ajna.losses import UncertaintyLoss, preset, presets, term_names

NAMES = term_names()


def random_maps(seed: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    prediction, raw, target = (torch.randn(2, 2, 3, 4, generator=random, dtype=dtype) for _ in range(3))
    return prediction, raw, target


def test_defaults_are_those_of_the_cpp_struct() -> None:
    ours, theirs = UncertaintyLoss().config, _core.LossConfig()
    for role in ("f", "h", "g", "parametrization"):
        assert getattr(ours, role).name == getattr(theirs, role).name
    assert ours.lam == theirs.lam


def test_value_is_the_papers_equation_one() -> None:
    prediction, raw, target = random_maps(0)
    expected = (prediction - target).abs() / nn.functional.softplus(raw + 1e-3) + nn.functional.softplus(raw)
    assert UncertaintyLoss()(prediction, raw, target).item() == pytest.approx(expected.mean().item(), rel=1e-12)


#: Every registered f, and every h and g under every raw -> a.
CHOICES = [
    *({"f": f, "h": "inv", "g": "log"} for f in NAMES["f"]),
    *({"h": h, "g": "log", "parametrization": p} for h, p in itertools.product(NAMES["h"], NAMES["parametrization"])),
    *({"h": "inv", "g": g, "parametrization": p} for g, p in itertools.product(NAMES["g"], NAMES["parametrization"])),
]


def assert_gradcheck(loss: UncertaintyLoss) -> None:
    prediction, raw, target = random_maps(1)
    prediction = (target + 0.5 + prediction.abs()).requires_grad_()  # away from the kink of |x|
    channels = loss(prediction, raw[:, :1], target, reduction="none").shape[1]
    raw = (0.3 + raw[:, :channels].abs()).requires_grad_()  # a > 0, as 1/a and log a demand
    mask = torch.rand(2, 1, 3, 4, generator=torch.Generator().manual_seed(2)) < 0.7
    weight = torch.rand(2, 1, 3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    assert torch.autograd.gradcheck(lambda p, r: loss(p, r, target, mask, weight), (prediction, raw))


@pytest.mark.filterwarnings("ignore::ajna.losses.AdmissibilityWarning")
@pytest.mark.parametrize("terms", CHOICES, ids=lambda terms: "-".join(terms.values()))
def test_gradcheck(terms: dict[str, Any]) -> None:
    assert_gradcheck(UncertaintyLoss(**terms, lam=0.7))


@pytest.mark.filterwarnings("ignore::ajna.losses.AdmissibilityWarning")
@pytest.mark.parametrize("name", [entry.name for entry in presets()])
def test_gradcheck_of_presets(name: str) -> None:
    assert_gradcheck(preset(name))


def test_gradcheck_of_the_target() -> None:
    prediction, raw, target = random_maps(4)
    target = (prediction.detach() - 1.0 - target.abs()).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: UncertaintyLoss()(prediction, raw, t), (target,))


@pytest.mark.parametrize("garbage", [math.nan, math.inf, -math.inf])
def test_masked_places_are_not_read(garbage: float) -> None:
    prediction, raw, target = random_maps(5, torch.float32)
    mask = torch.rand(2, 1, 3, 4, generator=torch.Generator().manual_seed(6)) < 0.5
    loss = UncertaintyLoss()
    expected = loss(prediction, raw, target, mask)
    dirty = [x.masked_fill(~mask, garbage).requires_grad_() for x in (prediction, raw)]
    value = loss(*dirty, target.masked_fill(~mask, garbage), mask)
    assert torch.equal(value, expected)
    value.backward()
    for x in dirty:
        assert x.grad is not None and torch.isfinite(x.grad).all()
        assert x.grad.masked_select(~mask).abs().sum() == 0


@pytest.mark.parametrize("size", [1e4, -1e4])
def test_extreme_raw_stays_finite_under_autocast(size: float) -> None:
    prediction, _, target = random_maps(7, torch.float32)
    raw = torch.full_like(prediction, size, requires_grad=True)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        value = UncertaintyLoss()(prediction.bfloat16(), raw, target)
    assert value.dtype == torch.float32 and torch.isfinite(value)
    value.backward()
    assert raw.grad is not None and torch.isfinite(raw.grad).all()


def test_expected_error_and_uncertainty() -> None:
    loss, raw = UncertaintyLoss(), torch.linspace(-8, 30, 50, dtype=torch.float64)
    assert torch.allclose(loss.uncertainty(raw), nn.functional.softplus(raw))
    assert torch.allclose(loss.expected_error(raw), nn.functional.softplus(raw + 1e-3).square(), rtol=1e-2)
    with torch.inference_mode():
        assert loss.expected_error(raw.float()).dtype == torch.float32


@pytest.mark.filterwarnings("ignore::ajna.losses.AdmissibilityWarning")
@pytest.mark.parametrize("name", [entry.name for entry in presets()])
def test_nothing_asked_of_a_loss_changes_it(name: str) -> None:
    loss = UncertaintyLoss.from_config({"preset": name})
    prediction = torch.randn(2, 3, 2, 2, generator=torch.Generator().manual_seed(1))
    raw, target = torch.full((2, 1, 2, 2), 0.7), torch.softmax(prediction.flip(0), 1)

    def asked() -> list[Tensor]:
        return [loss(prediction, raw, target), loss.expected_error(raw), loss.uncertainty(raw)]

    text, before = loss.describe(), asked()
    loss.error(prediction, target)
    loss.config.lam = 17.0
    loss.config.f.name = "l2"
    assert loss.describe() == text
    assert all(torch.equal(a, b) for a, b in zip(before, asked(), strict=True))
    entry = next(entry for entry in presets() if entry.name == name)
    entry.config.lam = 17.0
    assert entry.config.lam != 17.0


def test_training_a_raw_head_finds_the_expected_error() -> None:
    """The meaning of raw, end to end: minimising the loss makes expected_error the mean error."""
    errors = torch.tensor([0.2, 1.0, 4.0]).view(1, 3, 1, 1) * torch.ones(1, 3, 20, 20)
    noise = torch.empty(1, 3, 20, 20).exponential_(generator=torch.Generator().manual_seed(8))
    errors = errors * noise
    raw, loss = nn.Parameter(torch.zeros(1, 3, 1, 1)), UncertaintyLoss()
    optimizer = torch.optim.Adam([raw], lr=0.1)
    for _ in range(300):
        optimizer.zero_grad()
        loss(errors, raw.expand_as(errors), torch.zeros_like(errors)).backward()
        optimizer.step()
    assert torch.allclose(loss.expected_error(raw).flatten(), errors.mean((0, 2, 3)), rtol=0.02)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
def test_an_ordinary_module(duplicate: Any) -> None:
    loss = UncertaintyLoss("charbonnier", {"name": "inv_softplus", "params": {"eps": 0.01}}, lam=0.5).eval()
    assert not list(loss.parameters()) and loss.to("cpu") is loss
    clone = duplicate(loss)
    assert repr(clone) == repr(loss) and "eps=0.01" in repr(loss) and not clone.training
    maps = random_maps(9)
    assert torch.equal(clone(*maps), loss(*maps))
    assert nn.ModuleList([loss]).state_dict() == {}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"f": "l3"}, "l3"),
        ({"h": "inv_sofplus"}, "inv_softplus"),
        ({"g": {"name": "softplus", "params": {"eps": 1}}}, "no parameters"),
        ({"g": {"nam": "softplus"}}, "'nam'"),
        ({"g": {"params": {}}}, "'name'"),
        ({"h": 3}, "h = 3"),
        ({"lam": 0.0}, "lam"),
        ({"lam": math.nan}, "lam"),
        ({"parametrization": "sofplus"}, "softplus"),
    ],
)
def test_unusable_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        UncertaintyLoss(**options)


def test_calls_that_do_not_fit_are_named() -> None:
    loss, x = UncertaintyLoss(), torch.zeros(1, 2, 3, 4)
    with pytest.raises(ValueError, match="average"):
        loss(x, x, x, reduction="average")
    with pytest.raises(ValueError, match="mask"):
        loss(x, x, x, mask=torch.ones(5, 5))
    with pytest.raises(ValueError, match="differ in shape"):
        loss(x, x, torch.zeros(1, 2, 3, 5))
