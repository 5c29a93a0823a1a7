# SPDX-License-Identifier: MIT
"""The C++ network as an ordinary PyTorch graph, from which every exporter starts.

The C++ code runs once under `make_fx`, which records the operations that it calls, as TorchScript's tracer does for
`ajna export --format torchscript`. So there is still one definition of the network; the graph is a record of it.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, fx, nn

from ajna.nn import FlowNet


@contextmanager
def quiet() -> Iterator[None]:
    """Within the block nothing is recorded for gradients, and the exporters do not warn about their own insides."""
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        yield


class ExportableNet(nn.Module):
    """Network input [N, 6, H, W] float32 in [-1, 1] -> (raw, flow, uncertainty, expected_error), all float32.

    ``raw`` is what :class:`ajna.nn.FlowNet` gives [N, 4, H, W]; the others are [N, 2, H, W]: flow and expected error in
    pixels, the uncertainty in the unit of the loss. Any N; H and W are multiples of the network's stride.
    """

    def __init__(self, network: nn.Module, table: nn.Module, flow_scale: float, precision: torch.dtype) -> None:
        super().__init__()
        self.network, self.table = network, table
        self.flow_scale, self.precision = flow_scale, precision

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See the class."""
        raw = self.network(x.to(self.precision)).to(torch.float32)
        uncertainty, expected_error = self.table(raw[:, 2:4])
        return raw, raw[:, 0:2] * self.flow_scale, uncertainty, expected_error * self.flow_scale


def exportable(net: FlowNet, metadata: Mapping[str, Any], precision: torch.dtype = torch.float32) -> ExportableNet:
    """``net`` as a graph of PyTorch operations, batch normalisation folded into the convolutions.

    Args:
        net: a network from 6 to 4 channels in eval mode, on the CPU.
        metadata: as :func:`ajna.nn.load_checkpoint` returns it.
        precision: of the convolutions' weights and activations; input and outputs stay float32.

    Raises:
        ValueError: for another network, or one in training mode.
    """
    check_network(net)
    side = 2 * net.config.stride  # no size enters the graph
    network = _record(net, torch.zeros(1, net.config.in_channels, side, side))
    fold_batch_norms(network)
    network.to(precision)
    table = _record(metadata["table"].evaluate, torch.zeros(1, 2, side, side))
    return ExportableNet(network, table, float(metadata["flow_scale"]), precision).eval()


def to_channels_last(module: nn.Module) -> None:
    """Store the weights as the engine does, with the channels last, for which CPUs are quicker at this network."""
    module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # not in torch's stub


def check_network(net: FlowNet) -> None:
    """Raises ValueError unless ``net`` is one that is exported: 6 to 4 channels, in eval mode."""
    config = net.config
    if config.in_channels != 6 or config.out_channels != 4:
        raise ValueError(
            f"network from {config.in_channels} to {config.out_channels} channels: only networks from two RGB frames "
            "(6) to flow and uncertainty (4) are exported"
        )
    if net.training:
        raise ValueError("network is in training mode: call net.eval() before it is exported")


def check_size(net: FlowNet, width: int, height: int) -> None:
    """Raises ValueError, naming the nearest size, unless both sides are multiples of the network's stride."""
    stride = net.config.stride
    if width % stride or height % stride or width < 1 or height < 1:
        nearest = [max(1, round(side / stride)) * stride for side in (width, height)]
        raise ValueError(
            f"size {width}x{height} is fixed in the file and must be a multiple of the network's stride {stride}: "
            f"give for example {nearest[0]}x{nearest[1]}, and resize or pad the frames to it"
        )


def _record(function: Any, example: Tensor) -> fx.GraphModule:
    from torch.fx.experimental.proxy_tensor import make_fx

    # Before dispatch: later, composite operations are taken apart with the example's size in them.
    with torch.no_grad():
        module = make_fx(lambda x: function(x), pre_dispatch=True)(example)
    for node in module.graph.nodes:
        node.target = _WITHOUT_SCALARS.get(node.target, node.target)
    module.recompile()
    return module


# C++ calls these with a number where Python calls the other with one, and converters know only what Python calls.
_WITHOUT_SCALARS: dict[Any, Any] = {
    getattr(torch.ops.aten, name).Scalar: getattr(torch.ops.aten, name).Tensor for name in ("add", "sub", "mul", "div")
}

_CONVOLUTIONS = {torch.ops.aten.conv2d.default: False, torch.ops.aten.conv_transpose2d.input: True}  # transposed?


def fold_batch_norms(module: fx.GraphModule) -> int:
    """Merge each batch normalisation after a convolution into its weights, in float64; returns how many there were.

    Raises:
        ValueError: where one does not follow a convolution with constant weights of its own.
    """
    from torch.nn.utils.fusion import fuse_conv_bn_weights

    graph = module.graph
    norms = [node for node in graph.nodes if node.target == torch.ops.aten.batch_norm.default]
    for index, norm in enumerate(norms):
        conv, scale, shift, mean, var, _, _, eps = norm.args[:8]
        if conv.target not in _CONVOLUTIONS or len(conv.users) != 1:
            raise ValueError(f"batch normalisation '{norm.name}' does not follow a convolution: it cannot be folded")
        weight, bias, mean, var, scale, shift = (
            _constant(module, node).double() for node in (*conv.args[1:3], mean, var, scale, shift)
        )
        fused = fuse_conv_bn_weights(weight, bias, mean, var, eps, scale, shift, transpose=_CONVOLUTIONS[conv.target])
        for place, name, value in zip((1, 2), (f"weight{index}", f"bias{index}"), fused, strict=True):
            module.register_buffer(name, value.detach().float())
            with graph.inserting_before(conv):
                conv.update_arg(place, graph.get_attr(name))
        norm.replace_all_uses_with(conv)
    graph.eliminate_dead_code()
    module.recompile()
    _own_tensors(module)
    return len(norms)


def _own_tensors(module: fx.GraphModule) -> None:
    """Copies in place of the network's own tensors, which a change of type must not touch; unused ones are dropped."""
    used = {node.target for node in module.graph.nodes if node.op == "get_attr"}
    tensors = {**dict(module.named_parameters()), **dict(module.named_buffers())}
    for name, tensor in tensors.items():
        delattr(module, name)
        if name in used:
            module.register_buffer(name, tensor.detach().clone())


def _constant(module: fx.GraphModule, node: Any) -> Tensor:
    if not isinstance(node, fx.Node) or node.op != "get_attr":
        raise ValueError(f"operation '{node}' is not a constant of the graph: its batch normalisation cannot be folded")
    return getattr(module, str(node.target)).detach()
