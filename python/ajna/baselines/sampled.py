# SPDX-License-Identifier: MIT
"""Uncertainty from several passes: Monte Carlo dropout, deep ensembles, and a network's forward-backward distance.

All are called like a model, ``method(frame1, frame2)``, and say by ``cost(width, height)`` what one answer takes. Where
several flows are drawn, the answer is their mean, and its uncertainty the standard deviation per axis, in pixels. Its
2-norm over the axes is the root of the total variance, so that every figure that goes by order (AUSE, rank correlation,
ROC AUC) is the variance's, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ajna import nn
from ajna._core import nearest_name
from ajna.baselines.classical import (
    BaselineField,
    Cost,
    CostedMethod,
    Map,
    RgbImage,
    forward_backward_difference,
)
from ajna.model import FlowField, Model

#: Variance over the square of the expected absolute error, for the noise that a mixture assumes.
MIXTURES = {"laplace": 2.0, "gaussian": math.pi / 2.0}


@dataclass(frozen=True)
class SampledField(BaselineField):
    """Mean flow and standard deviation of several flows; float32 [H, W, 2] each, pixels."""

    label = "standard deviation"


class FlowMoments:
    """Running mean and variance of flow fields (Welford's update): memory does not grow with their number.

    The variance is that of the equal mixture of the fields: the mean squared deviation from their mean (divided by the
    number of fields, not by one less) plus, where given, the mean of the fields' own variances:
    ``Var = E[m^2] - E[m]^2 + E[v]`` (epistemic plus aleatoric; Lakshminarayanan et al. 2017, Kendall and Gal 2017).
    """

    def __init__(self) -> None:
        self.count = 0
        self._mean: NDArray[np.float64] = np.zeros(())
        self._deviation: NDArray[np.float64] = np.zeros(())
        self._own: NDArray[np.float64] = np.zeros(())

    def add(self, flow: NDArray[Any], variance: NDArray[Any] | None = None) -> None:
        """Add one field [H, W, 2] and, for a mixture, the variance that it claims, of the same shape."""
        self.count += 1
        difference = flow - self._mean
        self._mean = self._mean + difference / self.count
        self._deviation = self._deviation + difference * (flow - self._mean)
        if variance is not None:
            self._own = self._own + np.asarray(variance, dtype=np.float64)

    @property
    def mean(self) -> Map:
        """float32 [H, W, 2], pixels."""
        return self._mean.astype(np.float32)

    @property
    def variance(self) -> Map:
        """float32 [H, W, 2], square pixels."""
        return ((self._deviation + self._own) / self.count).astype(np.float32)

    def field(self) -> SampledField:
        """The mean with the standard deviation as uncertainty."""
        return SampledField(self.mean, np.sqrt(self.variance))


def noise_variance(expected_error: NDArray[Any], mixture: str | None) -> NDArray[np.float64] | None:
    """The variance that a network claims by its expected absolute error per axis; None for `mixture` None.

    Under a Laplace density of scale b the expected absolute error is b and the variance 2 b^2; under a Gaussian density
    they are s sqrt(2 / pi) and s^2.
    """
    if mixture is None:
        return None
    return MIXTURES[check_mixture(mixture)] * np.asarray(expected_error, dtype=np.float64) ** 2


def check_mixture(mixture: str) -> str:
    """The name itself; ValueError for an unknown one."""
    if mixture not in MIXTURES:
        near = nearest_name(mixture, list(MIXTURES))
        hint = f"did you mean '{near}'?" if near else f"known are {', '.join(MIXTURES)}."
        raise ValueError(f"mixture '{mixture}' is unknown; {hint}")
    return mixture


def check_sampling(rate: float, passes: int) -> None:
    """Raise ValueError for a rate that is no share or for too few passes."""
    if not 0.0 <= rate < 1.0:
        raise ValueError(f"dropout rate {rate:g} is not in [0, 1); give for example 0.1.")
    if passes < 2:
        raise ValueError(f"passes = {passes}: a variance needs at least 2 passes.")


# --- one network, two passes ---------------------------------------------------------------------------------------


class OnePass:
    """The model as it is, with its cost: what the others are measured against."""

    def __init__(self, model: Model) -> None:
        self.model = model

    def __call__(self, frame1: RgbImage, frame2: RgbImage, /) -> FlowField:
        return self.model(frame1, frame2)

    def cost(self, width: int, height: int) -> Cost:
        return _model_cost(self.model, width, height)


class ForwardBackward:
    """The forward-backward distance of the network's own flow, which ignores the uncertainty that it learned.

    The same measure as for OpenCV's flows, see :func:`ajna.baselines.forward_backward_difference`.
    """

    def __init__(self, model: Model) -> None:
        self.model = model

    def __call__(self, frame1: RgbImage, frame2: RgbImage, /) -> BaselineField:
        forward, backward = self.model(frame1, frame2).flow, self.model(frame2, frame1).flow
        return BaselineField(forward, np.abs(forward_backward_difference(forward, backward)))

    def cost(self, width: int, height: int) -> Cost:
        return _times(2, _model_cost(self.model, width, height))


def _model_cost(model: Model, width: int, height: int) -> Cost:
    config = nn.NetConfig()
    for name, value in model.info.network.items():
        setattr(config, name, value)
    return Cost(1, model.info.parameters, 2 * nn.count_macs(config, height, width))


def _times(passes: int, cost: Cost) -> Cost:
    return Cost(passes * cost.passes, cost.parameters, None if cost.flops is None else passes * cost.flops)


# --- several networks ----------------------------------------------------------------------------------------------


class DeepEnsemble:
    """Mean and spread of networks that were trained alike from different seeds (Lakshminarayanan et al. 2017).

    Args:
        members: two or more models.
        mixture: None for the spread of the flows alone (epistemic); "laplace" or "gaussian" to add the variance that
            each member claims by its expected error (see :func:`noise_variance`).

    Raises:
        ValueError: fewer than two members, one file twice, or an unknown mixture.
    """

    def __init__(self, members: Sequence[Model], mixture: str | None = None) -> None:
        if len(members) < 2:
            raise ValueError(f"an ensemble of {len(members)} has no spread; give at least 2 members.")
        hashes = [member.sha256 for member in members]
        for index, digest in enumerate(hashes):
            if digest in hashes[:index]:
                first = members[hashes.index(digest)].info.path
                raise ValueError(
                    f"ensemble members '{first}' and '{members[index].info.path}' are the same network; "
                    "give networks that were trained from different seeds."
                )
        self.members = list(members)
        self.mixture = None if mixture is None else check_mixture(mixture)

    def __call__(self, frame1: RgbImage, frame2: RgbImage, /) -> SampledField:
        moments = FlowMoments()
        for member in self.members:
            field = member(frame1, frame2)
            moments.add(field.flow, noise_variance(field.expected_error, self.mixture))
        return moments.field()

    def cost(self, width: int, height: int) -> Cost:
        costs = [_model_cost(member, width, height) for member in self.members]
        flops = [cost.flops or 0 for cost in costs]
        return Cost(len(costs), sum(cost.parameters for cost in costs), sum(flops))


# --- one network, many passes --------------------------------------------------------------------------------------


class McDropout:
    """Monte Carlo dropout (Gal and Ghahramani 2016) **injected into a network that was trained without dropout**.

    Whole channels of a layer's output are dropped at random in every pass and the rest scaled by 1 / (1 - rate) (what
    ``torch.nn.Dropout2d`` does in training mode). Layers run in C++, so the mask is put where it has the very same
    effect: on the affine of the layer's last normalization or convolution, which ReLU lets through as it is positive,
    and behind a residual block, whose sum has no affine, on the input channels of the next convolution. Every pass runs
    the whole network. Calls with the same frames give the same answer; not for several threads at once.

    A network that never saw dropout in training is no sample of a Bayesian posterior under it: read the result as the
    sensitivity of the flow to its features.

    Args:
        path: a checkpoint (.safetensors); the network in it is loaded for this object alone.
        rate: share of channels dropped, 0 (the plain network) up to 1, exclusive.
        passes: drawn per answer, at least 2.
        layers: names of layers, e.g. ``["encoder.5", "decoder.1"]``; by default the narrowest place, where the encoder
            ends. :func:`droppable_layers` lists them.
        seed: of the masks.
        mixture: as for :class:`DeepEnsemble`.
        device: where the network runs.

    Raises:
        ValueError: an option out of range, an unknown layer or mixture, or a foreign file.
        FileNotFoundError: there is no such file.
    """

    def __init__(
        self,
        path: str | Path,
        rate: float = 0.1,
        passes: int = 8,
        layers: Sequence[str] | None = None,
        seed: int = 0,
        mixture: str | None = None,
        device: str = "cpu",
    ) -> None:
        check_sampling(rate, passes)
        if Path(path).suffix != ".safetensors":
            raise ValueError(f"dropout needs the layers of '{path}', which only a checkpoint (.safetensors) has.")
        self.mixture = None if mixture is None else check_mixture(mixture)
        net, metadata = nn.load_checkpoint(path)
        known = droppable_layers(net)
        self.layers = tuple(layers) if layers is not None else (_narrowest(known),)
        for name in self.layers:
            if name not in known:
                near = nearest_name(name, known)
                hint = f"did you mean '{near}'?" if near else f"known are {', '.join(known)}."
                raise ValueError(f"the network has no layer '{name}' to drop channels of; {hint}")
        if len(set(self.layers)) < len(self.layers) or not self.layers:
            raise ValueError(f"dropout layers {list(self.layers)}: name one or more, each once.")
        self.rate, self.passes, self.seed, self.device = rate, passes, seed, torch.device(device)
        # The layout that the engine runs in, too.
        self.net = net.to(self.device)
        self.net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._scale, self._table = metadata["flow_scale"], metadata["table"].to(self.device)
        self._targets = [_affine_of(net, name) for name in self.layers]

    def __call__(self, frame1: RgbImage, frame2: RgbImage, /) -> SampledField:
        generator = torch.Generator().manual_seed(self.seed)
        x = nn.network_input(*(self._tensor(frame) for frame in (frame1, frame2)))
        x = x.contiguous(memory_format=torch.channels_last)
        moments = FlowMoments()
        for _ in range(self.passes):
            flow, expected_error = self._sample(x, generator)
            moments.add(flow, noise_variance(expected_error, self.mixture))
        return moments.field()

    def cost(self, width: int, height: int) -> Cost:
        flops = 2 * nn.count_macs(self.net.config, height, width)
        return _times(self.passes, Cost(1, nn.count_parameters(self.net), flops))

    def _tensor(self, frame: RgbImage) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(frame)).to(self.device).permute(2, 0, 1)[None]

    @torch.no_grad()
    def _sample(self, x: Tensor, generator: torch.Generator) -> tuple[Map, Map]:
        """Flow and expected error of one pass with fresh masks, pixels; the weights are as before afterwards."""
        kept: list[tuple[Tensor, Tensor]] = []
        try:
            for channels, tensors in self._targets:
                mask = (torch.rand(channels, generator=generator) >= self.rate).float() / (1.0 - self.rate)
                for tensor, axis in tensors:
                    kept.append((tensor, tensor.clone()))
                    shape = [channels if axis == index else 1 for index in range(tensor.dim())]
                    tensor.mul_(mask.to(tensor.device).view(shape))
            output = self.net(x)
        finally:
            for tensor, original in reversed(kept):
                tensor.copy_(original)
        error = self._table.evaluate(output[:, 2:4])[1] * self._scale
        return _array(output[:, :2] * self._scale), _array(error)


def _array(tensor: Tensor) -> Map:
    """[1, 2, H, W] -> [H, W, 2]."""
    return tensor[0].permute(1, 2, 0).cpu().numpy()


def _layers(net: nn.FlowNet) -> list[str]:
    return [f"{part}.{name}" for part in ("encoder", "decoder") for name, _ in net.get_submodule(part).named_children()]


def droppable_layers(net: nn.FlowNet) -> list[str]:
    """Names of the layers whose output channels :class:`McDropout` can drop: all but the last, which is the output."""
    return _layers(net)[:-1]


def _narrowest(layers: Sequence[str]) -> str:
    return [name for name in layers if name.startswith("encoder.")][-1]


def _affine_of(net: nn.FlowNet, layer: str) -> tuple[int, list[tuple[Tensor, int]]]:
    """Number of channels of a layer's output, and the tensors, each with its axis, that scale them one by one."""
    tensors = dict(net.named_parameters())
    if f"{layer}.norm2.weight" in tensors:  # a residual block: the next layer is a convolution unit
        names = _layers(net)
        following = names[names.index(layer) + 1]
        weight = tensors[f"{following}.conv.weight"]
        axis = 0 if following.startswith("decoder.") else 1  # a transposed convolution has its inputs first
        return weight.shape[axis], [(weight.data, axis)]
    if f"{layer}.norm.weight" in tensors:
        affine = [tensors[f"{layer}.norm.{name}"].data for name in ("weight", "bias")]
        return affine[0].numel(), [(tensor, 0) for tensor in affine]
    out_axis = 1 if layer.startswith("decoder.") else 0
    bias = tensors[f"{layer}.conv.bias"].data
    return bias.numel(), [(tensors[f"{layer}.conv.weight"].data, out_axis), (bias, 0)]


# --- by name -------------------------------------------------------------------------------------------------------

#: name -> what its row is called
SAMPLED = {
    "mc_dropout": "MC dropout",
    "mc_dropout_mixture": "MC dropout, mixture",
    "ensemble": "deep ensemble",
    "ensemble_mixture": "deep ensemble, mixture",
    "forward_backward": "forward-backward of our flow",
}


@dataclass(frozen=True)
class SamplingOptions:
    """Options of the sampled methods; see :class:`McDropout` and :func:`noise_variance`."""

    rate: float = 0.1
    passes: int = 8
    layers: tuple[str, ...] | None = None
    seed: int = 0
    mixture: str = "laplace"
    device: str = "cpu"


def make_sampled(
    name: str, model: Model, members: Sequence[Model] = (), options: SamplingOptions | None = None
) -> CostedMethod:
    """A method of `SAMPLED` by name.

    Args:
        model: the network of MC dropout and of the forward-backward distance.
        members: the networks of an ensemble.

    Raises:
        ValueError: an unknown name, or as the method's class says.
    """
    chosen = options or SamplingOptions()
    mixture = chosen.mixture if name.endswith("_mixture") else None
    if name.startswith("mc_dropout") and name in SAMPLED:
        layers = chosen.layers
        return McDropout(
            model.info.path, chosen.rate, chosen.passes, layers, chosen.seed, mixture, device=chosen.device
        )
    if name.startswith("ensemble") and name in SAMPLED:
        return DeepEnsemble(members, mixture)
    if name == "forward_backward":
        return ForwardBackward(model)
    near = nearest_name(name, list(SAMPLED))
    raise ValueError(f"unknown method '{name}'; " + (f"did you mean '{near}'?" if near else f"known: {list(SAMPLED)}."))
