# SPDX-License-Identifier: MIT
"""One choice of f, h, g from YAML, Python and C++: the same loss, gradients and expected error to the last bit."""

from __future__ import annotations

import os
import subprocess
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor

from ajna import _core
from ajna.losses import AdmissibilityWarning, UncertaintyLoss, preset, presets

BUILD = os.environ.get("AJNA_TEST_BUILD_DIR")
PROGRAM = Path(BUILD or ".") / "tests" / "cpp" / "loss_values"
NAMES = [entry.name for entry in presets()]
ROLES = ("f", "h", "g", "parametrization")

#: Own choices, as they stand in a YAML file.
OWN = {
    "parameters": """
        f: {name: huber, params: {delta: 0.75}}
        h: {name: inv_softplus, params: {eps: 0.05}}
        g: softplus
        lam: 0.3
        parametrization: none
        """,
    "expressions": """
        f: {name: "sqrt((prediction - target) ** 2 + k)", params: {k: 1e-2}}
        h: "1 / log(1 + exp(a + 1e-3))"
        g: "log(1 + exp(a))"
        """,
    "own parametrization": """
        f: l2
        h: inv
        g: log
        lam: 2
        parametrization: "softplus(raw) + 1e-2"
        """,
    "cross-entropy": "{f: cross_entropy, h: exp_neg, g: identity, parametrization: {name: exp, params: {scale: 0.25}}}",
}

pytestmark = pytest.mark.filterwarnings("ignore::ajna.losses.AdmissibilityWarning")


def numbers(channels: int, factor: int, offset: float) -> Tensor:
    """The maps of tests/cpp/loss_values.cpp, exact in binary."""
    values = (torch.arange(2 * channels * 2 * 3) * factor + 11).remainder(193)
    return (values.double() / 64 + offset).reshape(2, channels, 2, 3)


def evaluate(loss: Any) -> Tensor:
    """Loss, its gradients in prediction and raw, and the expected error, in one vector."""
    target = numbers(3, 29, -1.5)
    prediction, raw = numbers(3, 71, -1.25).requires_grad_(), numbers(1, 47, -0.7421875).requires_grad_()
    value = loss(prediction, raw, target)
    value.backward()
    assert prediction.grad is not None and raw.grad is not None
    parts = (value.detach(), prediction.grad, raw.grad, loss.expected_error(raw))
    return torch.cat([part.flatten() for part in parts])


def as_mapping(config: _core.LossConfig) -> dict[str, Any]:
    """What a YAML file holds for a loss."""
    terms = {role: getattr(config, role) for role in ROLES}
    return {**{role: {"name": t.name, "params": dict(t.params)} for role, t in terms.items()}, "lam": config.lam}


def keywords(mapping: Mapping[str, Any]) -> UncertaintyLoss:
    """By the constructor, plain names where there are no parameters."""
    options = dict(mapping)
    for role in set(ROLES) & set(options):
        if isinstance(options[role], dict) and not options[role].get("params"):
            options[role] = options[role]["name"]
    return UncertaintyLoss(**options)


@pytest.mark.parametrize("name", NAMES)
def test_presets_from_yaml_and_python(name: str) -> None:
    config = _core.loss_preset(name).config
    # Through text and back: 0.7071067811865475 must survive, too.
    spelled_out = yaml.safe_load(yaml.safe_dump(as_mapping(config)))
    ways = [
        preset(name),
        UncertaintyLoss.from_config(yaml.safe_load(f"preset: {name}")),
        UncertaintyLoss.from_config(spelled_out),
        keywords(spelled_out),
        _core.UncertaintyLoss(config),
    ]
    first, *others = (evaluate(loss) for loss in ways)
    assert first.isfinite().all() or name == "feng2019_printed"  # which has no h, hence no kappa
    for other in others:
        assert torch.equal(first.nan_to_num(7.0), other.nan_to_num(7.0))


@pytest.mark.parametrize("text", OWN.values(), ids=OWN.keys())
def test_own_choices_from_yaml_and_python(text: str) -> None:
    mapping = yaml.safe_load(text)
    for role in ROLES:  # YAML 1.1 reads 1e-2 as a string: the loss must not
        if isinstance(mapping.get(role), dict):
            assert set(mapping[role]["params"]) == set(
                getattr(UncertaintyLoss.from_config(mapping).config, role).params
            )
    first = evaluate(UncertaintyLoss.from_config(mapping))
    assert first.isfinite().all()
    assert torch.equal(first, evaluate(keywords(mapping)))


def test_a_training_config_builds_the_same_loss() -> None:
    options = pytest.importorskip("ajna.training.options", reason="needs the train extra")
    for name in NAMES:
        mapping = as_mapping(_core.loss_preset(name).config)
        ours, theirs = evaluate(options.LossOptions(**mapping).build()), evaluate(preset(name))
        assert torch.equal(ours.nan_to_num(7.0), theirs.nan_to_num(7.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('h: "1 / (1 + exp(a)"', r"missing '\)'"),
        ('g: "log(1 + exp(b))"', "unknown name at column 13"),
        ('parametrization: "softplus(a)"', "unknown name at column 10"),
        ('f: "abs(prediction - targt)"', "did you mean 'target'"),
        ('h: {name: "1 / (softplus(a) + k)", params: {k: .nan}}', "'k' .* not finite"),
        ('g: "log(a)"', "not finite"),
        ('g: "a + 1e999"', "out of range"),
        ("h: {name: inv_softplus, params: {epsilon: 1e-3}}", "'epsilon' Known: eps"),
        ("g: softpluss", "did you mean 'softplus'"),
        ("parametrisation: softplus", "did you mean 'parametrization'"),
        ("preset: kendal2017", "did you mean 'kendall2017'"),
        ("lam: .inf", "lam = inf"),
    ],
)
def test_faults_in_a_config_are_named_in_one_sentence(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        UncertaintyLoss.from_config(yaml.safe_load(text))
    assert "\n" not in str(caught.value)


# --- C++ -------------------------------------------------------------------------------------------------------------


def block(mapping: Mapping[str, Any]) -> list[str]:
    """A choice as lines for the C++ program."""
    lines = []
    for role in set(ROLES) & set(mapping):
        term = mapping[role] if isinstance(mapping[role], dict) else {"name": mapping[role]}
        lines.append(f"{role} {term['name']}")
        lines += [f"{role}.{key} {float(value)!r}" for key, value in (term.get("params") or {}).items()]
    if "lam" in mapping:
        lines.append(f"lam {mapping['lam']!r}")
    return [*lines, "end"]


@pytest.mark.skipif(
    not (BUILD and PROGRAM.is_file()), reason="loss_values is not built (AJNA_TEST_BUILD_DIR names the build)"
)
def test_cpp_gives_the_same_bits() -> None:
    spelled_out = [as_mapping(_core.loss_preset(name).config) for name in NAMES]
    own = [yaml.safe_load(text) for text in OWN.values()]
    lines = [line for name in NAMES for line in (f"preset {name}", "end")]
    lines += [line for mapping in (*spelled_out, *own) for line in block(mapping)]
    result = subprocess.run(
        [str(PROGRAM)], input="\n".join(lines) + "\n", capture_output=True, text=True, check=False, timeout=120
    )
    assert result.returncode == 0, result.stderr
    answers = [
        torch.tensor([float.fromhex(word) for word in line.split()], dtype=torch.float64)
        for line in result.stdout.splitlines()
    ]
    losses = [*map(preset, NAMES), *map(preset, NAMES), *map(UncertaintyLoss.from_config, own)]
    assert len(answers) == len(losses)
    for loss, theirs in zip(losses, answers, strict=True):
        ours = evaluate(loss)
        assert torch.equal(ours.nan_to_num(7.0), theirs.nan_to_num(7.0)), loss.describe()


# --- numerics --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16], ids=lambda dtype: str(dtype)[6:])
@pytest.mark.parametrize("autocast", [False, True], ids=["plain", "autocast"])
def test_every_preset_is_finite_at_extreme_raw(dtype: torch.dtype, autocast: bool) -> None:
    raws = torch.tensor([-1e4, -300.0, -30.0, -1.0, 0.5, 30.0, 300.0, 1e4]).view(1, 1, 1, -1)
    target = torch.tensor([0.1, -0.5, 0.3]).view(1, 3, 1, 1).expand(1, 3, 1, 8)
    lower = torch.float16 if dtype is torch.float16 else torch.bfloat16
    for name in NAMES:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AdmissibilityWarning)
            loss = preset(name)
        for size in (0.0, 1.0, 100.0):
            prediction = (target + size).to(dtype).requires_grad_()
            raw = raws.to(dtype).requires_grad_()
            with torch.autocast("cpu", dtype=lower, enabled=autocast):
                value = loss(prediction, raw, target)
                expected = loss.expected_error(raw)
            value.backward()
            assert value.dtype == torch.float32 and value.isfinite(), name
            for grad in (prediction.grad, raw.grad):
                assert grad is not None and grad.dtype == dtype and grad.isfinite().all(), (name, size)
            assert name == "feng2019_printed" or expected.isfinite().all(), name
