# SPDX-License-Identifier: MIT
"""The network as an ordinary ``torch.nn.Module`` over the C++ implementation.

The layers, the padding and the forward pass exist once, in C++ (``ajna::nn::FlowNetImpl``). This module mirrors the
tree of the C++ network by plain ``torch.nn.Module`` nodes that hold the *very same* tensors, so everything that works
on a PyTorch module works here too: optimizers, ``state_dict``, ``.to``, ``deepcopy``, pickle, autocast and
``DistributedDataParallel``.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from ajna import _core

NetConfig = _core.NetConfig

_DEFAULTS = NetConfig()
_CONFIG_FIELDS = ("width", "expansion", "sub_blocks", "in_channels", "out_channels")
_EXTRA_FIELDS = ("skip_connections", "scale_heads", "correlation_radius")  # 0 in the paper's network


class _Part(nn.Module):
    """One node of the mirrored tree: the parameters, buffers and children of one C++ module."""

    _core: Any
    _path: str

    def __init__(self, core: Any, path: str) -> None:
        super().__init__()
        self._core = core
        self._path = path

    def __setattr__(self, name: str, value: Any) -> None:
        # Also reached by train(), eval() and by tools that assign `training` directly (Lightning does).
        if name == "training" and "_core" in self.__dict__:
            self._core.set_training(self._path, bool(value))
        super().__setattr__(name, value)

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        raise RuntimeError(f"network part '{self._path}' only runs inside the whole network: call the FlowNet itself")

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> _Part:
        if recurse:
            for child in self.children():
                child._apply(fn)
        # Through .data: a replaced tensor would leave the C++ side with the old storage.
        with torch.no_grad():
            for name, tensor in (*self._parameters.items(), *self._buffers.items()):
                assert tensor is not None
                moved = fn(tensor)
                if moved.is_meta:
                    raise RuntimeError(
                        f"parameter '{name}' cannot move to the meta device: the C++ network needs storage"
                    )
                if tensor.grad is not None:
                    grad = fn(tensor.grad)
                    tensor.grad = None  # a gradient must agree with its parameter's dtype and device
                    tensor.data = moved
                    tensor.grad = grad
                else:
                    tensor.data = moved
        return self

    def _load_from_state_dict(self, state_dict: Any, prefix: str, local_metadata: Any, *args: Any) -> None:
        # assign=True would replace tensors; copying gives the same values and keeps both sides one storage.
        local_metadata = {**local_metadata, "assign_to_params_buffers": False}
        super()._load_from_state_dict(state_dict, prefix, local_metadata, *args)


class FlowNet(_Part):
    """The residual encoder-decoder of the paper; defaults give its 2,724,980 parameters.

    Called with ``x`` [N, in_channels, H, W], floating point in [-1, 1] (see :func:`network_input`), any H and W, it
    returns [N, out_channels, H, W]: u, v in training units (multiply by the checkpoint's ``flow_scale`` for pixels),
    then the raw uncertainty of u and of v. The GIL is released while the network runs.

    Hooks work on the network as a whole, not on its parts; parts hold parameters but are not callable.
    ``torch.func.functional_call`` and parametrizations replace parameters and are refused at the next forward pass.

    Args:
        width: channels after the first convolution, even, 2 to 1024.
        expansion: channel factor of each further down-sampling, 1 to 4.
        sub_blocks: residual block and down-sampling pairs after the stem, 0 to 4.
        in_channels: channels of the input.
        out_channels: channels of the output.
        skip_connections: add the encoder's outputs at 1/2 and 1/4 of the size, through a 1x1 convolution each, to the
            decoder's of equal size (not in the paper's network).
        scale_heads: predict at 1/4 and 1/2 of the size, too, each correcting the one before (see
            :meth:`forward_scales`).
        correlation_radius: compare both frames' features at 1/8 of the size over displacements up to this many cells;
            0 to 8, 0 leaves it out.

    Raises:
        ValueError: where an option is out of range, or at call time for an input of another shape or dtype.
    """

    def __init__(
        self,
        width: int = _DEFAULTS.width,
        expansion: int = _DEFAULTS.expansion,
        sub_blocks: int = _DEFAULTS.sub_blocks,
        in_channels: int = _DEFAULTS.in_channels,
        out_channels: int = _DEFAULTS.out_channels,
        skip_connections: bool = bool(_DEFAULTS.skip_connections),
        scale_heads: bool = bool(_DEFAULTS.scale_heads),
        correlation_radius: int = _DEFAULTS.correlation_radius,
    ) -> None:
        config = NetConfig()
        config.width, config.expansion, config.sub_blocks = width, expansion, sub_blocks
        config.in_channels, config.out_channels = in_channels, out_channels
        config.skip_connections, config.scale_heads = int(skip_connections), int(scale_heads)
        config.correlation_radius = correlation_radius
        self._attach(_core.FlowNetCore(config))

    @classmethod
    def _from_core(cls, core: Any) -> FlowNet:
        """Wrap an existing C++ network (for example a loaded one); both share it from then on."""
        net = cls.__new__(cls)
        net._attach(core)
        return net

    def _attach(self, core: Any) -> None:
        _Part.__init__(self, core, "")
        parts: dict[str, _Part] = {"": self}
        for path in core.module_names():
            if path:
                parent, _, name = path.rpartition(".")
                part = _Part(core, path)
                parts[parent].add_module(name, part)
                parts[path] = part
                nn.Module.__setattr__(part, "training", core.is_training(path))
        nn.Module.__setattr__(self, "training", core.is_training(""))
        self._bound: list[tuple[dict[str, Any], str, Tensor]] = []
        for path, tensor in core.named_parameters():
            tensor._is_param = True  # what isinstance(tensor, nn.Parameter) asks for; the C++ leaf itself stays
            self._bind(parts, path, tensor, buffer=False)
        for path, tensor in core.named_buffers():
            self._bind(parts, path, tensor, buffer=True)

    def _bind(self, parts: dict[str, _Part], path: str, tensor: Tensor, buffer: bool) -> None:
        parent, _, name = path.rpartition(".")
        table = parts[parent]._buffers if buffer else parts[parent]._parameters
        table[name] = tensor  # type: ignore[assignment]
        self._bound.append((table, name, tensor))

    @property
    def config(self) -> NetConfig:
        """The network's shape (a copy)."""
        return self._core.config

    def forward(self, x: Tensor) -> Tensor:
        """[N, in_channels, H, W] floating point -> [N, out_channels, H, W]; see the class."""
        self._check_bound()
        return self._core.forward(x)

    def forward_scales(self, x: Tensor) -> list[Tensor]:
        """The predictions from coarse to fine, the last at full size, all in the unit of the last; for a loss on each.

        Three with ``config.scale_heads``, else one. Both sides of ``x`` must be multiples of ``config.stride``.
        """
        self._check_bound()
        return self._core.forward_scales(x)

    def forward_layers(self, x: Tensor) -> list[Tensor]:
        """What each layer gives for ``x``, first to last (the output); for auxiliary losses and for looking inside.

        Both sides of ``x`` must be multiples of ``config.stride``.
        """
        self._check_bound()
        return self._core.forward_layers(x)

    def forward_scales_and_layers(self, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """:meth:`forward_scales` and :meth:`forward_layers` of one pass."""
        self._check_bound()
        return self._core.forward_scales_and_layers(x)

    def _check_bound(self) -> None:
        for table, name, tensor in self._bound:
            if table.get(name) is not tensor:
                raise RuntimeError(
                    f"parameter '{name}' of the network was replaced by another tensor: copy values in place "
                    "(param.data.copy_) or use load_state_dict"
                )

    def extra_repr(self) -> str:
        config = self.config
        extras = [field for field in _EXTRA_FIELDS if getattr(config, field)]
        return ", ".join(f"{field}={getattr(config, field)}" for field in (*_CONFIG_FIELDS, *extras))

    def __repr__(self) -> str:
        return f"FlowNet({self.extra_repr()})"

    def __getstate__(self) -> dict[str, Any]:
        own = {"_core", "_path", "_parameters", "_buffers", "_modules", "_bound", "training"}
        return {
            "tensors": {name: t.data for name, t in (*self.named_parameters(), *self.named_buffers())},
            "grads": {name: p.grad for name, p in self.named_parameters() if p.grad is not None},
            "frozen": [name for name, p in self.named_parameters() if not p.requires_grad],
            "training": {name: part.training for name, part in self.named_modules()},
            "attributes": {name: value for name, value in self.__dict__.items() if name not in own},
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state["attributes"])
        tensors = dict((*self.named_parameters(), *self.named_buffers()))
        for name, tensor in tensors.items():
            tensor.data = state["tensors"][name]
            tensor.requires_grad_(tensor.requires_grad and name not in state["frozen"])
        for name, grad in state["grads"].items():
            tensors[name].grad = grad
        for name, part in self.named_modules():
            part.training = state["training"][name]

    def __reduce__(self) -> tuple[Any, ...]:
        fields = (*_CONFIG_FIELDS, *_EXTRA_FIELDS)
        return type(self), tuple(getattr(self.config, field) for field in fields), self.__getstate__()

    def __deepcopy__(self, memo: dict[int, Any]) -> FlowNet:
        constructor, arguments, state = self.__reduce__()
        clone = constructor(*arguments)
        memo[id(self)] = clone
        # An optimizer that is copied together with the network must find the copied parameters.
        mine, theirs = dict(self.named_parameters()), dict(clone.named_parameters())
        memo.update({id(mine[name]): theirs[name] for name in mine})
        clone.__setstate__(copy.deepcopy(state, memo))
        return clone


def count_parameters(module: nn.Module) -> int:
    """Number of learnable scalars of ``module``."""
    return sum(p.numel() for p in module.parameters())


def count_macs(config: NetConfig, height: int, width: int) -> int:
    """Multiply-accumulates of one forward pass at [height, width] (2 FLOP each)."""
    return _core.count_macs(config, height, width)


def network_input(frame1: Tensor, frame2: Tensor) -> Tensor:
    """Two frames -> the network's input, the only pre-processing anywhere: x / 127.5 - 1, frame 1 before frame 2.

    Args:
        frame1, frame2: [N, 3, H, W] RGB, uint8 or floating point with values 0 to 255, on one device.

    Returns:
        float32 [N, 6, H, W] in [-1, 1].
    """
    return _core.network_input(frame1, frame2)


# How raw uncertainty is tabulated in a checkpoint, so that whoever loads it needs no loss.
_TABLE_MIN, _TABLE_MAX, _TABLE_STEP = -16.0, 64.0, 1.0 / 64.0


def uncertainty_table(loss: Any) -> Any:
    """What ``raw`` means under ``loss`` (an :class:`ajna.losses.UncertaintyLoss`), as a checkpoint carries it.

    Raises:
        ValueError: where the loss does not give finite, rising curves (an inadmissible choice of terms).
    """
    knots = round((_TABLE_MAX - _TABLE_MIN) / _TABLE_STEP) + 1
    raw = torch.linspace(_TABLE_MIN, _TABLE_MAX, knots, dtype=torch.float64)
    with torch.no_grad():
        uncertainty, error = loss.uncertainty(raw).float(), loss.expected_error(raw).float()
    return _core.UncertaintyTable(_TABLE_MIN, _TABLE_STEP, uncertainty, error)


def save_checkpoint(
    path: str | os.PathLike[str],
    net: FlowNet,
    name: str,
    loss: Any,
    flow_scale: float = 1.0,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write ``net`` with all that is needed to use it to a ``.safetensors`` file, atomically.

    Args:
        path: ends in ``.safetensors``.
        name: the model's name.
        loss: the :class:`ajna.losses.UncertaintyLoss` it was trained with; defines the uncertainty.
        flow_scale: network output times this is pixels.
        provenance: how it came about; values are stored as text.

    Raises:
        ValueError: for an unusable loss or path; RuntimeError where the file cannot be written.
    """
    metadata = _metadata(net, name, loss.describe(), uncertainty_table(loss), flow_scale, provenance or {})
    _core.save_checkpoint(os.fspath(path), net._core, metadata)


def load_checkpoint(path: str | os.PathLike[str]) -> tuple[FlowNet, dict[str, Any]]:
    """Read a checkpoint, strictly; nothing in the file is executed.

    Returns:
        (the network in eval mode, metadata): ``name``, ``flow_scale``, ``loss``, ``provenance`` (a dict), ``table``
        (raw -> uncertainty and expected error) and ``calibration`` (``_core.Calibration``, None where it has none).

    Raises:
        FileNotFoundError, ValueError: for a missing file, or one that is truncated or not an Ajna checkpoint.
    """
    core, metadata = _core.load_checkpoint(os.fspath(path))
    return FlowNet._from_core(core), {
        "name": metadata.name,
        "flow_scale": metadata.flow_scale,
        "loss": metadata.loss,
        "provenance": dict(metadata.provenance),
        "table": metadata.table,
        "calibration": metadata.calibration,
    }


def export_torchscript(path: str | os.PathLike[str], net: FlowNet, metadata: Mapping[str, Any]) -> None:
    """Write ``net`` as a frozen TorchScript file that runs without Ajna, verified against ``net`` and atomically.

    Its methods: ``forward(x)`` as :class:`FlowNet` in eval mode, and ``predict(frame1, frame2)`` on uint8 [N, 3, H, W]
    RGB -> (flow, uncertainty, expected_error), each [N, 2, H, W] float32, flow and expected error in pixels.

    Args:
        path: the file to write.
        net: a network of 6 to 4 channels; it is not changed.
        metadata: as :func:`load_checkpoint` returns it; its calibration is taken along.

    Raises:
        ValueError: for another network, or metadata that do not fit it; RuntimeError where writing fails.
    """
    _core.export_torchscript(os.fspath(path), net._core, metadata_object(net, metadata))


def metadata_object(net: FlowNet, metadata: Mapping[str, Any]) -> Any:
    """What :func:`load_checkpoint` returned beside ``net``, as the ``_core.CheckpointMetadata`` that writers take.

    Raises:
        ValueError: where an entry is missing.
    """
    fields = ("name", "loss", "table", "flow_scale", "provenance")
    missing = [field for field in fields if field not in metadata]
    if missing:
        raise ValueError(f"model metadata lack '{missing[0]}': give what load_checkpoint returned beside the network")
    filled = _metadata(net, *(metadata[field] for field in fields))
    filled.calibration = metadata.get("calibration")
    return filled


def _metadata(net: FlowNet, name: str, loss: str, table: Any, flow_scale: float, provenance: Mapping[str, Any]) -> Any:
    metadata = _core.CheckpointMetadata()
    metadata.name, metadata.net, metadata.flow_scale = name, net.config, flow_scale
    metadata.loss, metadata.table = loss, table
    metadata.provenance = {key: str(value) for key, value in provenance.items()}
    return metadata
