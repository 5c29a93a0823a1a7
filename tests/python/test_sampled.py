# SPDX-License-Identifier: MIT
"""MC dropout, deep ensembles and forward-backward of the network: against brute force, and what they refuse."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.nn import functional as F

import ajna
from ajna import nn
from ajna.baselines import (
    SAMPLED,
    BaselineField,
    DeepEnsemble,
    FlowMoments,
    ForwardBackward,
    McDropout,
    OnePass,
    SamplingOptions,
    droppable_layers,
    forward_backward_difference,
    make_sampled,
    noise_variance,
)

Pair = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def members(member_runs: Path) -> list[ajna.Model]:
    return [ajna.load(path) for path in sorted(member_runs.glob("*/model.safetensors"))]


def plain(path: Path, frame1: np.ndarray, frame2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flow and expected error of the network as it is, without folding: float32 [H, W, 2]."""
    net, metadata = nn.load_checkpoint(path)
    net.to(memory_format=torch.channels_last)
    x = nn.network_input(*(torch.from_numpy(frame).permute(2, 0, 1)[None] for frame in (frame1, frame2)))
    with torch.no_grad():
        output = net(x.contiguous(memory_format=torch.channels_last))
    error = metadata["table"].evaluate(output[:, 2:4])[1]
    return tuple((item * metadata["flow_scale"])[0].permute(1, 2, 0).numpy() for item in (output[:, :2], error))  # type: ignore[return-value]


# --- moments -------------------------------------------------------------------------------------------------------


def test_moments_are_those_of_numpy() -> None:
    random = np.random.default_rng(0)
    flows = 100 + random.normal(size=(7, 5, 6, 2)).astype(np.float32)
    own = random.uniform(0.1, 2, size=flows.shape)
    epistemic, total = FlowMoments(), FlowMoments()
    for flow, variance in zip(flows, own, strict=True):
        epistemic.add(flow)
        total.add(flow, variance)
    exact = flows.astype(np.float64)
    assert np.allclose(epistemic.mean, exact.mean(axis=0), rtol=1e-6)
    assert np.allclose(epistemic.variance, exact.var(axis=0), rtol=1e-5)
    assert np.allclose(total.variance, exact.var(axis=0) + own.mean(axis=0), rtol=1e-5)
    assert np.allclose(total.field().uncertainty, np.sqrt(total.variance))
    # The same from the moments of the mixture: E[m^2] + E[v] - E[m]^2.
    mixture = (exact**2 + own).mean(axis=0) - exact.mean(axis=0) ** 2
    assert np.allclose(total.variance, mixture, rtol=1e-4)


def test_memory_does_not_grow_with_the_passes() -> None:
    def held(passes: int) -> int:
        moments = FlowMoments()
        for _ in range(passes):
            moments.add(np.ones((5, 6, 2), np.float32), np.ones((5, 6, 2)))
        return sum(np.asarray(value).nbytes for value in vars(moments).values())

    assert held(2) == held(50)


@pytest.mark.parametrize("mixture", ["laplace", "gaussian"])
def test_claimed_variance_is_that_of_the_density(mixture: str) -> None:
    random = np.random.default_rng(0)
    samples = random.laplace(size=200_000) if mixture == "laplace" else random.normal(size=200_000)
    claimed = noise_variance(np.float64([np.abs(samples).mean()]), mixture)
    assert claimed is not None and claimed[0] == pytest.approx(samples.var(), rel=0.03)
    assert noise_variance(np.ones(1), None) is None


# --- ensembles -----------------------------------------------------------------------------------------------------


def test_ensemble_is_mean_and_spread_of_its_members(members: list[ajna.Model], frame_pair: Pair) -> None:
    fields = [member(*frame_pair) for member in members]
    flows = np.stack([field.flow for field in fields]).astype(np.float64)
    result = DeepEnsemble(members)(*frame_pair)
    assert result.flow.dtype == result.uncertainty.dtype == np.float32
    assert np.allclose(result.flow, flows.mean(axis=0), atol=1e-6)
    assert np.allclose(result.uncertainty, flows.std(axis=0), atol=1e-6) and result.uncertainty.max() > 1e-3
    errors = np.stack([field.expected_error for field in fields]).astype(np.float64)
    mixed = DeepEnsemble(members, "laplace")(*frame_pair)
    assert np.array_equal(mixed.flow, result.flow)
    assert np.allclose(mixed.uncertainty, np.sqrt(flows.var(axis=0) + (2 * errors**2).mean(axis=0)), rtol=1e-5)


def test_ensembles_that_are_none_are_refused(members: list[ajna.Model]) -> None:
    with pytest.raises(ValueError, match="an ensemble of 1 has no spread; give at least 2"):
        DeepEnsemble(members[:1])
    with pytest.raises(ValueError, match="are the same network; give networks that were trained from different seeds"):
        DeepEnsemble([members[0], members[1], members[0]])
    with pytest.raises(ValueError, match="mixture 'laplce' is unknown; did you mean 'laplace'"):
        DeepEnsemble(members, "laplce")


# --- MC dropout ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layers", [None, ["encoder.0", "encoder.2", "encoder.3", "decoder.1", "decoder.2"]])
def test_rate_zero_is_the_plain_network(tiny_checkpoint: Path, frame_pair: Pair, layers: list[str] | None) -> None:
    result = McDropout(tiny_checkpoint, rate=0, passes=3, layers=layers)(*frame_pair)
    flow, error = plain(tiny_checkpoint, *frame_pair)
    assert np.array_equal(result.flow, flow) and not result.uncertainty.any()
    assert np.allclose(flow, ajna.load(tiny_checkpoint)(*frame_pair).flow, atol=1e-5)
    mixed = McDropout(tiny_checkpoint, rate=0, passes=3, mixture="laplace")(*frame_pair)
    assert np.allclose(mixed.uncertainty, np.sqrt(2) * error, rtol=1e-5)


def test_seeds_decide_and_the_network_stays_as_it_was(tiny_checkpoint: Path, frame_pair: Pair) -> None:
    options = {"rate": 0.3, "passes": 4, "layers": ["encoder.2", "encoder.3", "decoder.4"]}
    method = McDropout(tiny_checkpoint, seed=5, **options)
    before = {name: tensor.clone() for name, tensor in method.net.state_dict().items()}
    first, again = method(*frame_pair), method(*frame_pair)
    assert all(torch.equal(tensor, before[name]) for name, tensor in method.net.state_dict().items())
    other = McDropout(tiny_checkpoint, seed=6, **options)(*frame_pair)
    for part in ("flow", "uncertainty"):
        assert np.array_equal(getattr(first, part), getattr(again, part))
        assert not np.array_equal(getattr(first, part), getattr(other, part))
    assert first.uncertainty.mean() > 0


def test_mean_and_spread_are_those_of_the_passes(tiny_checkpoint: Path, frame_pair: Pair) -> None:
    method = McDropout(tiny_checkpoint, rate=0.5, passes=5)
    flows = []
    sample = method._sample
    method._sample = lambda *given: flows.append(sample(*given)) or flows[-1]
    result = method(*frame_pair)
    drawn = np.stack([flow for flow, _ in flows]).astype(np.float64)
    assert drawn.shape[0] == 5
    assert np.allclose(result.flow, drawn.mean(axis=0), atol=1e-6)
    assert np.allclose(result.uncertainty, drawn.std(axis=0), atol=1e-6)


@pytest.mark.parametrize(
    "layer", ["encoder.0", "encoder.2", "encoder.3", "encoder.5", "decoder.1", "decoder.2", "decoder.5"]
)
def test_scaling_weights_is_dropping_the_output_channels(tiny_checkpoint: Path, layer: str) -> None:
    """Against torch's own dropout of the layer's output: what the next layer sees, hence all that follows."""
    rate = 0.4
    method = McDropout(tiny_checkpoint, rate=rate, passes=2, layers=[layer])
    names = [*droppable_layers(method.net), "decoder.6"]
    index = names.index(layer)
    x = torch.rand(1, 6, 32, 48, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.no_grad():
        outputs = method.net.forward_layers(x)
        inside: list[list[torch.Tensor]] = []
        method.net.forward = lambda given: inside.append(method.net.forward_layers(given)) or inside[-1][-1]
        method._sample(x, torch.Generator().manual_seed(3))
    channels = outputs[index].shape[1]
    mask = (torch.rand(channels, generator=torch.Generator().manual_seed(3)) >= rate).float() / (1 - rate)
    assert mask.min() == 0, "the seed drops a channel"
    dropped = outputs[index] * mask[:, None, None]
    if layer in ("encoder.2", "decoder.2"):  # behind a residual block the next convolution drops its inputs
        following = dict(method.net.named_parameters())
        weight, bias = (following[f"{names[index + 1]}.conv.{name}"] for name in ("weight", "bias"))
        with torch.no_grad():
            if layer.startswith("encoder"):
                expected = F.conv2d(dropped, weight, bias, stride=2, padding=1)
            else:
                expected = F.conv_transpose2d(dropped, weight, bias, stride=2, padding=1, output_padding=1)
        assert torch.allclose(inside[0][index + 1], expected, atol=1e-5)
    else:
        assert torch.allclose(inside[0][index], dropped, atol=1e-5)


def test_options_of_dropout_are_checked(tiny_checkpoint: Path, tmp_path: Path) -> None:
    for options, message in (
        ({"rate": 1.0}, r"dropout rate 1 is not in \[0, 1\)"),
        ({"rate": -0.1}, "dropout rate -0.1 is not in"),
        ({"passes": 1}, "passes = 1: a variance needs at least 2"),
        ({"layers": ["encodr.5"]}, "no layer 'encodr.5' to drop channels of; did you mean 'encoder.5'"),
        ({"layers": ["decoder.6"]}, "no layer 'decoder.6' to drop"),
        ({"layers": []}, "name one or more, each once"),
        ({"layers": ["encoder.1", "encoder.1"]}, "name one or more, each once"),
        ({"mixture": "cauchy"}, "mixture 'cauchy' is unknown; "),
    ):
        with pytest.raises(ValueError, match=message):
            McDropout(tiny_checkpoint, **options)
    with pytest.raises(ValueError, match=r"only a checkpoint \(.safetensors\) has"):
        McDropout(tmp_path / "model.pt")
    with pytest.raises(FileNotFoundError):
        McDropout(tmp_path / "nowhere.safetensors")


# --- forward-backward, cost, names ---------------------------------------------------------------------------------


def test_forward_backward_of_the_network(members: list[ajna.Model], frame_pair: Pair) -> None:
    first, second = frame_pair
    result = ForwardBackward(members[0])(first, second)
    forward, backward = members[0](first, second).flow, members[0](second, first).flow
    assert isinstance(result, BaselineField) and np.array_equal(result.flow, forward)
    assert np.array_equal(result.uncertainty, np.abs(forward_backward_difference(forward, backward)))


def test_costs_are_passes_times_the_network(members: list[ajna.Model], tiny_checkpoint: Path) -> None:
    net, _ = nn.load_checkpoint(tiny_checkpoint)
    flops, parameters = 2 * nn.count_macs(net.config, 48, 64), nn.count_parameters(net)
    assert OnePass(members[0]).cost(64, 48) == (1, parameters, flops)
    assert ForwardBackward(members[0]).cost(64, 48) == (2, parameters, 2 * flops)
    assert DeepEnsemble(members).cost(64, 48) == (3, 3 * parameters, 3 * flops)
    assert McDropout(tiny_checkpoint, passes=6).cost(64, 48) == (6, parameters, 6 * flops)


def test_every_name_makes_its_method(members: list[ajna.Model]) -> None:
    options = SamplingOptions(rate=0.2, passes=3, layers=("encoder.1",), seed=4, mixture="gaussian")
    made = {name: make_sampled(name, members[0], members, options) for name in SAMPLED}
    dropout = made["mc_dropout"]
    assert isinstance(dropout, McDropout) and dropout.mixture is None
    assert (dropout.rate, dropout.passes, dropout.layers, dropout.seed) == (0.2, 3, ("encoder.1",), 4)
    assert made["mc_dropout_mixture"].mixture == made["ensemble_mixture"].mixture == "gaussian"
    assert made["ensemble"].mixture is None and isinstance(made["forward_backward"], ForwardBackward)
    with pytest.raises(ValueError, match="unknown method 'mc_drop_out'; did you mean 'mc_dropout'"):
        make_sampled("mc_drop_out", SimpleNamespace())
