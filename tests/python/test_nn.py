# SPDX-License-Identifier: MIT
"""FlowNet in Python is an ordinary torch.nn.Module over the C++ network: both sides always see the same tensors."""

from __future__ import annotations

import copy
import io
import json
import pickle
import threading
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor, nn

from ajna import _core
from ajna.losses import UncertaintyLoss
from ajna.nn import FlowNet, count_macs, count_parameters, load_checkpoint, network_input, save_checkpoint


@pytest.fixture
def net() -> FlowNet:
    torch.manual_seed(0)
    return FlowNet(width=4).eval()


@pytest.fixture
def x() -> Tensor:
    return torch.rand(2, 6, 32, 48, generator=torch.Generator().manual_seed(1)) * 2 - 1


def tensors(net: FlowNet) -> dict[str, Tensor]:
    return dict((*net.named_parameters(), *net.named_buffers()))


def assert_one_storage(net: FlowNet) -> None:
    """The C++ network holds the tensors that Python shows, not copies."""
    shown = tensors(net)
    for name, tensor in (*net._core.named_parameters(), *net._core.named_buffers()):
        assert shown[name] is tensor, name


# --- shape ---------------------------------------------------------------------------------------------------------


def test_size_is_the_papers() -> None:
    net = FlowNet()
    assert count_parameters(net) == 2_724_980
    assert count_parameters(FlowNet(in_channels=1, out_channels=1)) == 2_714_785
    assert 2 * count_macs(net.config, 240, 320) == pytest.approx(6.33e9, abs=5e6)


def test_defaults_are_those_of_the_cpp_struct() -> None:
    assert FlowNet().config == _core.NetConfig()
    assert repr(FlowNet()) == "FlowNet(width=32, expansion=2, sub_blocks=2, in_channels=6, out_channels=4)"


@pytest.mark.parametrize("size", [(1, 1), (17, 31), (16, 16), (5, 64)])
def test_output_is_as_large_as_the_input(net: FlowNet, size: tuple[int, int]) -> None:
    assert net(torch.rand(2, 6, *size)).shape == (2, 4, *size)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"width": 7}, "width = 7"), ({"expansion": 9}, "expansion = 9"), ({"sub_blocks": -1}, "sub_blocks = -1")],
)
def test_options_out_of_range_are_named(options: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FlowNet(**options)


@pytest.mark.parametrize("wrong", [torch.rand(1, 3, 16, 16), torch.rand(6, 16, 16), torch.zeros(1, 6, 9, 9).byte()])
def test_inputs_that_do_not_fit_are_named(net: FlowNet, wrong: Tensor) -> None:
    with pytest.raises(ValueError, match="N, 6, H, W"):
        net(wrong)


def test_equal_seeds_give_equal_networks(x: Tensor) -> None:
    nets = []
    for seed in (3, 3, 4):
        torch.manual_seed(seed)
        nets.append(FlowNet(width=4).eval())
    assert torch.equal(nets[0](x), nets[1](x))
    assert not torch.equal(nets[0](x), nets[2](x))


# --- an ordinary module --------------------------------------------------------------------------------------------


def test_parameters_and_buffers_are_the_cpp_ones(net: FlowNet) -> None:
    assert_one_storage(net)
    assert all(isinstance(p, nn.Parameter) and p.is_leaf and p.requires_grad for p in net.parameters())
    assert isinstance(net.encoder, nn.Module)
    assert net.get_parameter("encoder.0.conv.weight").shape == (4, 6, 7, 7)


def test_values_written_in_python_reach_cpp(net: FlowNet, x: Tensor) -> None:
    with torch.no_grad():
        for p in net.parameters():
            p.zero_()
    assert net(x).abs().max() == 0


def test_state_dict_round_trip_is_strict(net: FlowNet, x: Tensor) -> None:
    torch.manual_seed(9)
    other = FlowNet(width=4).eval()
    assert not torch.equal(net(x), other(x))
    other.load_state_dict(net.state_dict())
    assert torch.equal(net(x), other(x))
    other.load_state_dict(net.state_dict(), assign=True)
    assert_one_storage(other)
    state = net.state_dict()
    state["encoder.0.conv.bogus"] = state.pop("encoder.0.conv.bias")
    with pytest.raises(RuntimeError, match=r"Missing key.*bias(.|\n)*Unexpected key.*bogus"):
        other.load_state_dict(state)


def test_state_dict_of_a_parent_has_the_prefix(net: FlowNet) -> None:
    parent = nn.Sequential(net)
    assert set(parent.state_dict()) == {f"0.{name}" for name in net.state_dict()}
    parent.load_state_dict(parent.state_dict())


def test_train_and_eval_return_self_and_reach_batch_normalisation(net: FlowNet, x: Tensor) -> None:
    still = net(x)
    assert net.train() is net
    assert not torch.allclose(net(x), still, atol=1e-3), "batch statistics are in use"
    assert net.eval() is net
    moved = net(x)
    assert not torch.equal(moved, still), "running statistics have moved"
    assert torch.equal(net(x), moved)


def test_modes_of_parts_follow(net: FlowNet) -> None:
    net.train()
    net.encoder.eval()
    assert net._core.is_training("decoder.0") and net._core.is_training("")
    assert not net._core.is_training("encoder") and not net._core.is_training("encoder.0.norm")
    # Lightning restores modes by assignment, parent before child.
    modes = {name: part.training for name, part in net.named_modules()}
    net.eval()
    for name, part in net.named_modules():
        part.training = modes[name]
    assert all(net._core.is_training(name) == mode for name, mode in modes.items())


def test_to_returns_self_and_keeps_one_storage(net: FlowNet, x: Tensor) -> None:
    expected = net(x)
    assert net.to(torch.float64) is net
    assert_one_storage(net)
    assert net(x.double()).dtype == torch.float64
    assert torch.allclose(net(x.double()).float(), expected, atol=1e-5)
    net.float()
    net.to(memory_format=torch.channels_last)
    assert_one_storage(net)
    assert net.get_parameter("encoder.0.conv.weight").is_contiguous(memory_format=torch.channels_last)
    assert torch.allclose(net(x.contiguous(memory_format=torch.channels_last)), expected, atol=1e-5)
    assert torch.allclose(net.share_memory()(x), expected, atol=1e-5)


def test_to_carries_gradients(net: FlowNet, x: Tensor) -> None:
    net(x).sum().backward()
    before = [p.grad.clone() for p in net.parameters() if p.grad is not None]
    net.double()
    for p, grad in zip(net.parameters(), before, strict=True):
        assert p.grad is not None and p.grad.dtype == torch.float64
        assert torch.equal(p.grad.float(), grad)


def test_meta_device_is_refused(net: FlowNet) -> None:
    with pytest.raises(RuntimeError, match="meta"):
        net.to("meta")


def copied(net: FlowNet) -> FlowNet:
    return copy.deepcopy(net)


def pickled(net: FlowNet) -> FlowNet:
    return pickle.loads(pickle.dumps(net))


def saved(net: FlowNet) -> FlowNet:
    file = io.BytesIO()
    torch.save(net, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


@pytest.mark.parametrize("duplicate", [copied, pickled, saved])
def test_duplicates_are_equal_and_apart(net: FlowNet, x: Tensor, duplicate: Any) -> None:
    net.train()
    net.encoder.eval()
    net.get_parameter("encoder.0.conv.bias").requires_grad_(False)
    net.to(memory_format=torch.channels_last)
    net.note = "kept"
    clone = duplicate(net)
    assert clone.config == net.config and clone.note == "kept"
    assert_one_storage(clone)
    assert {n: m.training for n, m in clone.named_modules()} == {n: m.training for n, m in net.named_modules()}
    assert not clone.get_parameter("encoder.0.conv.bias").requires_grad
    assert clone.get_parameter("encoder.0.conv.weight").is_contiguous(memory_format=torch.channels_last)
    net.eval(), clone.eval()
    expected = net(x)
    assert torch.equal(clone(x), expected)
    with torch.no_grad():
        for p in clone.parameters():
            p.add_(1.0)
    assert torch.equal(net(x), expected), "the original must not have moved"


def test_an_optimizer_copied_with_its_network_drives_the_copy(net: FlowNet, x: Tensor) -> None:
    optimizer = torch.optim.SGD(net.parameters(), lr=0.1)
    clone, copied_optimizer = copy.deepcopy((net, optimizer))
    before = net(x)
    clone(x).square().mean().backward()
    copied_optimizer.step()
    assert torch.equal(net(x), before)
    assert not torch.equal(clone(x), before)


def test_hooks_of_the_whole_network_run(net: FlowNet, x: Tensor) -> None:
    seen = []
    net.register_forward_hook(lambda module, args, output: seen.append(output.shape))
    net(x)
    assert seen == [(2, 4, 32, 48)]


def test_parts_are_not_callable(net: FlowNet, x: Tensor) -> None:
    with pytest.raises(RuntimeError, match="whole network"):
        net.encoder(x)


def test_a_replaced_parameter_is_noticed(net: FlowNet, x: Tensor) -> None:
    replaced = {name: torch.zeros_like(p) for name, p in net.named_parameters()}
    with pytest.raises(RuntimeError, match="replaced"):
        torch.func.functional_call(net, replaced, (x,))


# --- training ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("optimizer", [torch.optim.AdamW, torch.optim.SGD])
def test_optimizers_reduce_the_loss(net: FlowNet, x: Tensor, optimizer: Any) -> None:
    net.train()
    optimizer = optimizer(net.parameters(), lr=3e-3)
    losses = []
    for _ in range(8):
        optimizer.zero_grad()
        loss = (net(x) - 0.5).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]


def test_frozen_parameters_get_no_gradient(net: FlowNet, x: Tensor) -> None:
    net.encoder.requires_grad_(False)
    net(x).sum().backward()
    assert all(p.grad is None for p in net.encoder.parameters())
    assert all(p.grad is not None for p in net.decoder.parameters())


def test_autocast_computes_in_bfloat16_and_trains(net: FlowNet, x: Tensor) -> None:
    expected = net(x)
    net.train()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = net(x)
    assert output.dtype == torch.bfloat16
    output.float().square().mean().backward()
    assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in net.parameters())
    net.eval()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.isfinite(net(x)).all() and net(x).shape == expected.shape


def test_the_interpreter_lock_is_free_during_forward(net: FlowNet) -> None:
    """Another thread must get on while one forward pass runs: it can only do so without the lock."""
    wide = FlowNet(width=16).eval()
    x, done, beats = torch.rand(1, 6, 256, 256), threading.Event(), []

    def beat() -> None:
        while not done.is_set():
            beats.append(None)

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        with torch.no_grad():
            wide(x)  # threads are warm
            before = len(beats)
            wide._core.forward(x)  # one call into C++: no bytecode in between
            after = len(beats)
    finally:
        done.set()
        thread.join()
    assert after > before


def test_torch_jit_trace_sees_the_parameters(net: FlowNet, x: Tensor) -> None:
    traced = torch.jit.trace(net, x, check_trace=False)
    assert torch.equal(traced(x), net(x))


def _train_two_steps(rank: int, port: int, folder: str) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    try:
        torch.manual_seed(rank)  # different starts: DDP must make them equal
        net = FlowNet(width=4)
        ddp = nn.parallel.DistributedDataParallel(net)
        optimizer = torch.optim.SGD(ddp.parameters(), lr=0.05)
        for step in range(2):
            x = torch.rand(2, 6, 32, 32, generator=torch.Generator().manual_seed(10 * rank + step))
            optimizer.zero_grad()
            ddp(x).square().mean().backward()
            optimizer.step()
        state = ddp.state_dict()
        assert all(name.startswith("module.") for name in state)
        torch.save({"state": state, "grads": [p.grad for p in net.parameters()]}, f"{folder}/{rank}.pt")
    finally:
        dist.destroy_process_group()


@pytest.mark.skipif(not dist.is_available() or not dist.is_gloo_available(), reason="torch without gloo")
def test_distributed_data_parallel_keeps_two_processes_equal(tmp_path: Path) -> None:
    store = dist.TCPStore("127.0.0.1", 0, 1, is_master=True, wait_for_workers=False)
    port = store.port
    del store
    mp.spawn(_train_two_steps, args=(port, str(tmp_path)), nprocs=2)
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in (0, 1))
    for a, b in zip(first["grads"], second["grads"], strict=True):
        assert torch.equal(a, b)
    names = [name for name, _ in FlowNet(width=4).named_parameters()]
    assert all(torch.equal(first["state"][f"module.{n}"], second["state"][f"module.{n}"]) for n in names)


# --- input and files -----------------------------------------------------------------------------------------------


def test_network_input_scales_and_stacks() -> None:
    one, two = torch.zeros(1, 3, 2, 2, dtype=torch.uint8), torch.full((1, 3, 2, 2), 255, dtype=torch.uint8)
    assert torch.equal(network_input(one, two), torch.cat([-torch.ones(1, 3, 2, 2), torch.ones(1, 3, 2, 2)], 1))


def test_checkpoint_round_trip(net: FlowNet, x: Tensor, tmp_path: Path) -> None:
    loss = UncertaintyLoss()
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, net, name="tiny", loss=loss, flow_scale=4.0, provenance={"steps": 12})
    loaded, metadata = load_checkpoint(path)
    assert torch.equal(loaded(x), net(x)) and not loaded.training
    assert (metadata["name"], metadata["flow_scale"], metadata["provenance"]) == ("tiny", 4.0, {"steps": "12"})
    assert metadata["loss"] == loss.describe()
    raw = torch.tensor([-12.0, -3.3, 0.01, 2.0, 40.0])
    uncertainty, error = metadata["table"].evaluate(raw)
    assert torch.allclose(uncertainty, loss.uncertainty(raw), rtol=1e-3, atol=1e-5)
    assert torch.allclose(error, loss.expected_error(raw), rtol=1e-3, atol=1e-6)


def test_a_channels_last_network_is_saved_the_same(net: FlowNet, x: Tensor, tmp_path: Path) -> None:
    expected = net(x)
    net.to(memory_format=torch.channels_last)
    save_checkpoint(tmp_path / "m.safetensors", net, name="m", loss=UncertaintyLoss())
    assert torch.equal(load_checkpoint(tmp_path / "m.safetensors")[0](x), expected)


def test_checkpoints_are_read_by_safetensors(net: FlowNet, tmp_path: Path) -> None:
    safetensors = pytest.importorskip("safetensors")
    path = tmp_path / "m.safetensors"
    save_checkpoint(path, net, name="m", loss=UncertaintyLoss())
    with safetensors.safe_open(path, framework="pt") as file:
        assert torch.equal(file.get_tensor("encoder.0.conv.weight"), net.get_parameter("encoder.0.conv.weight"))
        json.dumps(file.metadata())


def test_an_inadmissible_loss_is_not_saved(net: FlowNet, tmp_path: Path) -> None:
    loss = UncertaintyLoss(h="inv", g="log")  # raw below 0 has no meaning without a parametrization
    with pytest.raises(ValueError):
        save_checkpoint(tmp_path / "m.safetensors", net, name="m", loss=loss)
    assert not list(tmp_path.iterdir())
