# SPDX-License-Identifier: MIT
"""Own terms, admissibility, presets, likelihoods and multi-scale losses from Python; the C++ side is in tests/cpp."""

from __future__ import annotations

import copy
import json
import math
import pickle
import warnings
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor

from ajna import _core
from ajna.cli import main
from ajna.losses import (
    AdmissibilityWarning,
    UncertaintyLoss,
    expression_functions,
    preset,
    presets,
)

ADMISSIBLE = [entry.name for entry in presets() if not entry.name.endswith("_printed")]
PRINTED = [entry.name for entry in presets() if entry.name.endswith("_printed")]


def maps(seed: int = 0, channels: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    prediction, raw, target = (torch.randn(2, channels, 3, 4, generator=random, dtype=torch.float64) for _ in range(3))
    return prediction, raw, target


def value_and_gradients(loss: Any) -> list[Tensor]:
    prediction, raw, target = maps(3)
    prediction.requires_grad_(), raw.requires_grad_()
    value = loss(prediction, raw, target)
    value.backward()
    assert prediction.grad is not None and raw.grad is not None
    return [value.detach(), prediction.grad, raw.grad]


def own_attenuation(a: Tensor) -> Tensor:
    return 1 / torch.nn.functional.softplus(a + 1e-3)


class Attenuation(torch.autograd.Function):
    """A Python backward, which C++'s kappa must be able to call."""

    @staticmethod
    def forward(ctx: Any, a: Tensor) -> Tensor:
        ctx.save_for_backward(a)
        return own_attenuation(a)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # type: ignore[override]
        (a,) = ctx.saved_tensors
        return -grad * torch.sigmoid(a + 1e-3) * own_attenuation(a).square()


def attenuation_with_python_backward(a: Tensor) -> Tensor:
    return Attenuation.apply(a)  # type: ignore[no-any-return]


# --- one choice, from anywhere --------------------------------------------------------------------------------------


def test_yaml_python_and_cpp_give_the_same_loss_and_gradients() -> None:
    text = """
    f: {name: charbonnier, params: {eps: 1e-2}}
    h: inv_square
    g: log_square
    lam: 0.3
    parametrization: {name: exp, params: {scale: 0.5}}
    """
    config = _core.LossConfig()
    config.f = _core.TermSpec("charbonnier", {"eps": 1e-2})
    config.h, config.g = _core.TermSpec("inv_square"), _core.TermSpec("log_square")
    config.lam, config.parametrization = 0.3, _core.TermSpec("exp", {"scale": 0.5})
    chosen = [
        UncertaintyLoss.from_config(yaml.safe_load(text)),
        UncertaintyLoss(
            {"name": "charbonnier", "params": {"eps": 0.01}},
            "inv_square",
            "log_square",
            0.3,
            {"name": "exp", "params": {"scale": 0.5}},
        ),
        _core.UncertaintyLoss(config),
    ]
    results = [value_and_gradients(loss) for loss in chosen]
    for other in results[1:]:
        assert all(torch.equal(mine, theirs) for mine, theirs in zip(results[0], other, strict=True))


@pytest.mark.parametrize("h", [own_attenuation, attenuation_with_python_backward, "1 / log(1 + exp(a + 1e-3))"])
def test_own_terms_equal_the_registered_one(h: Any) -> None:
    own, registered = UncertaintyLoss(h=h), UncertaintyLoss()
    for mine, theirs in zip(value_and_gradients(own), value_and_gradients(registered), strict=True):
        assert torch.allclose(mine, theirs, rtol=1e-9)
    raw = torch.linspace(-10, 60, 30, dtype=torch.float64)
    assert torch.allclose(own.expected_error(raw), registered.expected_error(raw), rtol=1e-6)
    with torch.inference_mode():
        assert own.expected_error(raw.float()).dtype == torch.float32


def test_an_own_error_term_and_constants() -> None:
    constant = {"k": 0.5}
    h, g = {"name": "1 / (a + k)", "params": constant}, {"name": "log(a + k)", "params": constant}
    own = UncertaintyLoss(f=lambda p, t: (p - t).abs(), h=h, g=g, parametrization="softplus", strict=True)
    prediction, raw, target = maps(1)
    a = torch.nn.functional.softplus(raw)
    expected = (prediction - target).abs() / (a + 0.5) + (a + 0.5).log()
    assert torch.allclose(own(prediction, raw, target), expected.mean())
    assert torch.allclose(own.expected_error(raw), a + 0.5)
    norm = UncertaintyLoss(f="norm(prediction - target)")
    assert norm(prediction, raw[:, :1], target, reduction="none").shape == (2, 1, 3, 4)


def test_own_terms_stay_finite_at_extreme_raw_in_float32() -> None:
    loss = UncertaintyLoss(h="1 / log(1 + exp(a + 1e-3))", g="log(1 + exp(a))")
    raw = torch.tensor([-1e4, -11.0, 0.0, 88.0, 1e4], requires_grad=True)
    value = loss(torch.ones(5), raw, torch.zeros(5), reduction="none")
    value.sum().backward()
    assert value.isfinite().all() and raw.grad is not None and raw.grad.isfinite().all()
    assert raw.grad[-1] > 0 > raw.grad[0]


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
def test_own_terms_can_be_copied(duplicate: Any) -> None:
    for h in (own_attenuation, "1 / log(1 + exp(a + 1e-3))"):
        loss = UncertaintyLoss(h=h)
        clone = duplicate(loss)
        assert repr(clone) == repr(loss)
        assert torch.equal(clone(*maps()), loss(*maps()))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"h": "1 / (a + 1"}, r"missing '\)' at column 11"),
        ({"h": "1 / (x + 1)"}, "unknown name at column 6"),
        ({"h": "1 / sofplus(a)"}, "did you mean 'softplus'"),
        ({"h": "1 / a"}, "not finite"),
        ({"h": "a.exp()"}, "column 2"),
        ({"f": "abs(prediction - truth)"}, "column 18"),
        ({"f": "log(prediction - target)"}, "not finite"),
        ({"h": lambda a: 1.0}, "return a torch.Tensor"),
        ({"h": lambda a: a.sum()}, "shape"),
        ({"h": lambda a: a.detach()}, "differentiated"),
        ({"g": {"name": "log", "params": {"x": 1}}}, "no parameters"),
        ({"f": {"name": "huber", "params": {"delta": "wide"}}}, "'wide'"),
        ({"f": {"name": "huber", "params": {"delta": 0}}}, "above 0"),
        ({"f": "hubr"}, "huber"),
    ],
)
def test_faults_of_terms_are_named_in_one_sentence(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        UncertaintyLoss(**options)
    assert "\n" not in str(caught.value)


def test_from_config_names_unknown_options() -> None:
    with pytest.raises(ValueError, match="did you mean 'lam'"):
        UncertaintyLoss.from_config({"lamb": 1.0})
    assert UncertaintyLoss.from_config({"preset": "poggi2020", "lam": 0.5}).config.lam == 0.5
    assert "exp" in expression_functions()


# --- admissibility and presets --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ADMISSIBLE)
def test_presets_are_admissible_and_raw_finds_the_expected_error(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", AdmissibilityWarning)
        loss = preset(name, strict=True)
    assert loss.check() and loss.check().reason == ""
    # Where the loss over raw is least, for a fixed error, kappa is that error.
    raw = torch.linspace(-8, 20, 28001, dtype=torch.float64)
    curves = loss.curves(raw)
    # An angle's mean lies below pi/2, and a confidence of 1 already costs 0.2.
    for error in (0.3, 1.2) if name == "bae2021" else (0.3, 1.2, 7.0):
        best = (curves["h"] * error + loss.config.lam * curves["g"]).argmin()
        assert curves["kappa"][best].item() == pytest.approx(error, rel=2e-3)
        assert loss.expected_error(raw[best]).item() == pytest.approx(error, rel=2e-3)


@pytest.mark.parametrize("name", PRINTED)
def test_printed_forms_warn_and_strict_refuses(name: str) -> None:
    with pytest.warns(AdmissibilityWarning, match="inadmissible"):
        loss = preset(name)
    report = loss.check()
    assert not report and report.fails_at is not None and report.reason
    with pytest.raises(ValueError, match="inadmissible"):
        preset(name, strict=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        copy.deepcopy(loss)  # the original has warned


def test_the_check_of_a_domain() -> None:
    with pytest.warns(AdmissibilityWarning):
        loss = UncertaintyLoss(h="inv", g="log")
    assert not loss.check() and loss.check(0.1, 20.0)
    assert loss.check(0.5, 20.0).error_max == pytest.approx(20.0)
    with pytest.raises(ValueError, match="raw_min < raw_max"):
        loss.check(1.0, 1.0)


def test_unknown_presets_suggest_the_nearest() -> None:
    with pytest.raises(ValueError, match="kendall2017"):
        preset("kendal2017")


def test_the_command_prints_every_preset(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["losses", "--json"]) == 0
    records = json.loads(capsys.readouterr().out)
    assert [record["name"] for record in records] == [entry.name for entry in presets()]
    assert sum(record["reference"] is not None and record["check"]["admissible"] for record in records) == 17
    assert main(["losses"]) == 0
    text = capsys.readouterr().out
    assert all(entry.name in text for entry in presets()) and "\u2026" not in text


# --- likelihoods ----------------------------------------------------------------------------------------------------


def test_normalised_presets() -> None:
    assert [name for name in ADMISSIBLE if preset(name).is_normalised()] == ["poggi2020", "li2021", "bae2021"]
    assert preset("martinbrualla2021").is_normalised(channels=2)
    assert not UncertaintyLoss().is_normalised()
    with pytest.raises(ValueError, match="not the likelihood"):
        UncertaintyLoss().interval(0.9, torch.zeros(3))


def test_laplace_and_gauss_are_those_of_torch() -> None:
    prediction, raw, target = maps(5)
    scale = torch.nn.functional.softplus(raw)
    for name, density in (
        ("poggi2020", torch.distributions.Laplace(prediction, scale)),
        ("bhatt2021", torch.distributions.Normal(prediction, scale)),
    ):
        loss = preset(name)
        assert torch.allclose(loss.nll(prediction, raw, target), -density.log_prob(target))
        assert torch.allclose(loss.cdf(target - prediction, raw), density.cdf(target))
        share = torch.tensor(0.83, dtype=torch.float64)
        assert torch.allclose(loss.quantile(share, raw), density.icdf(share) - prediction)
        low, high = loss.interval(0.9, raw)
        assert torch.allclose(high, density.icdf(torch.tensor(0.95)).double() - prediction, rtol=1e-4)
        assert torch.allclose(low, -high)


def test_nll_is_the_loss_up_to_a_constant_where_normalised() -> None:
    prediction, raw, target = maps(6)
    loss = preset("poggi2020")
    gap = loss.nll(prediction, raw, target) - loss(prediction, raw, target, reduction="none")
    assert torch.allclose(gap, torch.full_like(gap, math.log(2)))


@pytest.mark.parametrize("name", ["poggi2020", "kendall2017", "bae2021"])
def test_samples_have_the_expected_error(name: str) -> None:
    torch.manual_seed(7)
    loss, raw = preset(name), torch.full((200_000,), -0.4, dtype=torch.float64)
    errors = loss.sample(raw)
    f = errors.square() if name == "kendall2017" else errors.abs()
    assert f.mean().item() == pytest.approx(loss.expected_error(raw[:1]).item(), rel=0.02)
    low, high = loss.interval(0.7, raw[:1])
    assert ((errors >= low) & (errors <= high)).double().mean().item() == pytest.approx(0.7, abs=0.01)


# --- several scales -------------------------------------------------------------------------------------------------


def test_several_scales() -> None:
    loss, (prediction, raw, target) = UncertaintyLoss(), maps(8)
    coarse = [x[..., :1, :2] for x in (prediction, raw)]
    pooled = torch.nn.functional.adaptive_avg_pool2d(target, (1, 2))
    expected = loss(prediction, raw, target) + 0.5 * loss(*coarse, pooled)
    value = loss([prediction, coarse[0]], [raw, coarse[1]], target, scale_weights=[1.0, 0.5])
    assert torch.allclose(value, expected)
    with pytest.raises(ValueError, match="both as lists"):
        loss([prediction], raw, target)
    with pytest.raises(ValueError, match="one raw per prediction"):
        loss([prediction], [], target)
    with pytest.raises(ValueError, match="none"):
        loss([prediction], [raw], target, reduction="none")
