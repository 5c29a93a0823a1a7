# SPDX-License-Identifier: MIT
"""The parts that training stands on: sample stream, schedules, one optimisation step, checkpoint files."""

from __future__ import annotations

import math
from collections import Counter
from itertools import islice, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("lightning")
pytest.importorskip("jsonargparse")

from lightning.pytorch.core.optimizer import LightningOptimizer

from ajna.training import FlowModule, LossOptions, NetOptions, OptimOptions, SceneStream, Stage, SyntheticData
from ajna.training.options import GuidanceOptions, check_stages
from ajna.training.run_folder import AtomicCheckpointIO
from ajna.training.seeds import training_seed, validation_seed
from ajna.training.stream import augment

# --- the sample stream ---------------------------------------------------------------------------------------------


def fake_scenes(stage: Stage) -> Any:
    """A generator whose frames carry their seed, so that samples can be followed."""

    def generate(batch: int, height: int, width: int, seed: int, flow_scale: float) -> Any:
        random = torch.Generator().manual_seed(seed % 2**31)
        frame = torch.randint(0, 256, (batch, 3, 1, 1), generator=random, dtype=torch.uint8)
        frame = frame.expand(-1, -1, height, width).contiguous()
        flow = torch.randn(batch, 2, height, width, generator=random) * flow_scale
        hidden = torch.zeros(batch, 1, height, width, dtype=torch.bool)
        return SimpleNamespace(frame1=frame, frame2=frame.clone(), flow=flow, occlusion=hidden)

    return generate


STAGES = [
    Stage(0, 4, 6, 3),
    Stage(5, 4, 4, 2, reuse=3, pool=4),
    Stage(12, 4, 6, 3, reuse=2, pool=2),
    Stage(33, 2, 2, 1),
]


@pytest.mark.parametrize("prefetch", [0, 3])
@pytest.mark.parametrize("start", [0, 3, 5, 6, 8, 10, 11, 12, 14, 19, 32, 40])
def test_a_stream_from_any_step_continues_the_same_samples(start: int, prefetch: int) -> None:
    whole = list(islice(SceneStream(fake_scenes, STAGES, seed=1), 50))
    part = list(islice(SceneStream(fake_scenes, STAGES, seed=1, start=start, prefetch=prefetch), 50 - start))
    for ours, theirs in zip(part, whole[start:], strict=True):
        assert ours["step"] == theirs["step"]
        assert all(torch.equal(ours[n], theirs[n]) for n in ("frame1", "frame2", "flow", "occlusion"))


def test_every_generated_sample_is_used_reuse_times() -> None:
    stage = Stage(0, 4, 4, 2, reuse=3, pool=4)
    uses: Counter[float] = Counter()
    for batch in islice(SceneStream(fake_scenes, [stage], seed=1), 12):
        uses.update(batch["flow"].abs().sum((1, 2, 3)).double().round(decimals=3).tolist())
    assert len(uses) == 8 and set(uses.values()) == {3}


def test_ranks_and_seeds_see_different_samples() -> None:
    streams = [SceneStream(fake_scenes, STAGES, seed, rank) for seed, rank in ((1, 0), (1, 1), (2, 0))]
    flows = [next(iter(stream))["flow"] for stream in streams]
    assert not torch.equal(flows[0], flows[1]) and not torch.equal(flows[0], flows[2])


def test_an_error_in_the_background_reaches_the_training() -> None:
    def broken(stage: Stage) -> Any:
        raise ValueError("no scenes today")

    with pytest.raises(ValueError, match="no scenes today"):
        next(iter(SceneStream(broken, STAGES, seed=1, prefetch=2)))


def test_validation_seeds_are_no_training_seeds() -> None:
    training = {
        training_seed(run, stage, n, rank)
        for run in range(3)
        for stage in range(3)
        for n in range(50)
        for rank in (0, 1)
    }
    validation = {validation_seed(n) for n in range(50)}
    assert len(training) == 900 and len(validation) == 50
    assert max(training) < 2**62 <= min(validation) and max(validation) < 2**63


def shifted(batch: int, size: int, u: int, v: int) -> dict[str, Any]:
    """Frames that agree under one flow everywhere (they wrap around)."""
    frame1 = torch.randint(0, 256, (batch, 3, size, size), dtype=torch.uint8)
    flow = torch.tensor([float(u), float(v)]).view(1, 2, 1, 1).expand(batch, 2, size, size)
    frame2 = frame1.roll((v, u), (2, 3))
    return {"frame1": frame1, "frame2": frame2, "flow": flow, "occlusion": torch.zeros(batch, 1, size, size).bool()}


def test_augmentation_is_exact_for_the_flow() -> None:
    torch.manual_seed(0)
    batch = shifted(6, 8, u=2, v=-1)
    kept = {name: value.clone() for name, value in batch.items()}
    motions = set()
    for seed in range(20):
        result = augment(batch, seed)
        for i in range(6):
            u, v = (int(c) for c in result["flow"][i, :, 0, 0])
            motions.add((u, v))
            assert torch.equal(result["frame2"][i], result["frame1"][i].roll((v, u), (1, 2)))
    assert motions == {(s * a, t * b) for a, b in ((2, 1), (1, 2)) for s in (1, -1) for t in (1, -1)}
    assert all(torch.equal(batch[name], kept[name]) for name in kept), "the input is shared and must stay"


# --- options -------------------------------------------------------------------------------------------------------


def test_learning_rate_rises_then_falls_to_its_end() -> None:
    optim = OptimOptions(lr=1.0, warmup_steps=10, final_lr_ratio=0.1)
    rates = [optim.lr_at(step, 100) for step in range(121)]
    assert rates[0] == pytest.approx(0.1) and max(rates) == pytest.approx(1.0)
    assert all(a < b for a, b in pairwise(rates[:10]))
    assert all(a >= b for a, b in pairwise(rates[10:]))
    assert rates[100] == rates[120] == pytest.approx(0.1)


def test_the_flow_is_handed_over_smoothly() -> None:
    loss = LossOptions(l1_steps=10, blend_steps=20, l1_share=0.25, raw_gradient=0.1)
    shares = [loss.flow_share(step) for step in range(40)]
    assert shares[:11] == [0.0] * 11 and shares[30:] == [0.75] * 10
    assert all(0 <= b - a < 0.06 for a, b in pairwise(shares))
    assert loss.raw_share(0) == 0.1 and loss.raw_share(39) == pytest.approx(1.0)
    assert LossOptions(l1_steps=5, blend_steps=0).flow_share(5) == 1.0


@pytest.mark.parametrize("stages", [[], [Stage(1, 8, 8, 1)], [Stage(0, 8, 8, 1), Stage(0, 8, 8, 1)]])
def test_stages_must_begin_at_zero_and_rise(stages: list[Stage]) -> None:
    with pytest.raises(ValueError, match="give"):
        check_stages(stages)


# --- the module ----------------------------------------------------------------------------------------------------


def module_of(**loss: Any) -> FlowModule:
    torch.manual_seed(0)
    return FlowModule(NetOptions(width=4), LossOptions(**loss), flow_scale=2.0)


def batch_of(value: float = 1.0) -> dict[str, Any]:
    batch = shifted(2, 16, u=1, v=0)
    return {**batch, "flow": torch.full((2, 2, 16, 16), value)}


def gradients(module: FlowModule, output: Tensor, batch: dict[str, Any], step: int) -> Tensor:
    output = output.clone().requires_grad_()
    module.objective(output, batch, step).backward()
    assert output.grad is not None
    return output.grad


def test_the_flow_learns_by_l1_first_and_raw_by_the_uncertainty_loss_always() -> None:
    module = module_of(l1_steps=10, blend_steps=10)
    output, batch = torch.randn(2, 4, 16, 16), batch_of()
    early, late = gradients(module, output, batch, 0), gradients(module, output, batch, 100)
    target = batch["flow"] / 2.0
    l1 = (output[:, :2] - target).sign() / target.numel()
    assert torch.allclose(early[:, :2], l1)
    whole = output.clone().requires_grad_()
    module.loss(whole[:, :2], whole[:, 2:], target).backward()
    assert whole.grad is not None
    assert torch.allclose(late, whole.grad)
    assert torch.allclose(early[:, 2:], whole.grad[:, 2:])


def test_occluded_pixels_can_be_left_out() -> None:
    module = module_of(occluded_weight=0.0, l1_steps=10)
    batch = batch_of()
    batch["occlusion"][:, :, :8] = True
    grad = gradients(module, torch.randn(2, 4, 16, 16), batch, 0)
    assert grad[:, :, :8].abs().sum() == 0 and (grad[:, :, 8:] != 0).all()


class _Optimizer(LightningOptimizer):
    """The optimizer as Lightning hands it out, without a strategy."""

    def step(self, *args: Any, **kwargs: Any) -> Any:
        return self._optimizer.step()


def run_steps(module: FlowModule, batches: list[dict[str, Any]]) -> Any:
    """The module's own training_step without a trainer around it."""
    optimizer = module.configure_optimizers()
    module._trainer = None
    module._fabric = None
    trainer = SimpleNamespace(max_steps=100, world_size=1, log_every_n_steps=1, should_stop=False)
    patched = pytest.MonkeyPatch()
    with patched.context() as patch:
        patch.setattr(FlowModule, "trainer", trainer, raising=False)
        patch.setattr(module, "log_dict", lambda values: None)
        patch.setattr(module, "manual_backward", lambda loss: loss.backward())
        patch.setattr(module, "optimizers", lambda: _Optimizer(optimizer))
        for index, batch in enumerate(batches):
            module.training_step(batch, index)


def test_a_step_that_is_not_finite_is_skipped_and_counted() -> None:
    module = module_of()
    before = {name: p.clone() for name, p in module.net.named_parameters()}
    statistics = {name: b.clone() for name, b in module.net.named_buffers()}
    run_steps(module, [batch_of(math.nan)])
    assert (module.skipped, module.steps_done) == (1, 1)
    assert all(torch.equal(p, before[name]) for name, p in module.net.named_parameters())
    assert all(torch.equal(b, statistics[name]) for name, b in module.net.named_buffers())
    run_steps(module, [batch_of()])
    assert any(not torch.equal(b, statistics[name]) for name, b in module.net.named_buffers())
    assert module.skipped == 1
    assert any(not torch.equal(p, before[name]) for name, p in module.net.named_parameters())


def test_too_many_bad_steps_in_a_row_end_the_run(tmp_path: Path) -> None:
    module = FlowModule(NetOptions(width=4), optim=OptimOptions(max_bad_steps=3))
    module.failure_folder = tmp_path
    with pytest.raises(RuntimeError, match="3 steps in a row"):
        run_steps(module, [batch_of(math.inf)] * 5)
    assert [path.name for path in tmp_path.iterdir()] == ["bad-batch-step-0000002.npz"]


def test_the_averaged_network_follows_and_stays_in_eval_mode() -> None:
    module = module_of()
    module.train()
    assert module.net.training and not module.ema.training
    run_steps(module, [batch_of()] * 3)
    for average, current in zip(module.ema.parameters(), module.net.parameters(), strict=True):
        assert not average.requires_grad
        assert average.shape == current.shape
    assert any(not torch.equal(a, c) for a, c in zip(module.ema.parameters(), module.net.parameters(), strict=True))


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path: Path) -> None:
    path, files = tmp_path / "last.ckpt", AtomicCheckpointIO()
    files.save_checkpoint({"step": 1}, path)
    with pytest.raises(Exception, match=r"pickle|local"):
        files.save_checkpoint({"step": 2, "bad": lambda: None}, path)
    assert torch.load(path, weights_only=True) == {"step": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["last.ckpt"]


def test_scenes_of_a_stage_take_its_own_options() -> None:
    stages = [Stage(0, 8, 8, 1, scene={"layers": 0}), Stage(2, 8, 8, 1)]
    data = SyntheticData(stages, scene={"bank_size": 2, "texture_size": 16, "layers": 1})
    assert [data.generator(stage).config.layers for stage in stages] == [0, 1]
    with pytest.raises(ValueError, match="layers"):
        SyntheticData([Stage(0, 8, 8, 1, scene={"layer": 0})])


def test_every_scale_is_trained_on_the_averaged_truth() -> None:
    torch.manual_seed(3)
    quiet = GuidanceOptions(motion_energy=False, heads_weight=0.0)
    options = NetOptions(width=8, scale_heads=True, skip_connections=True)
    frames = {name: torch.randint(0, 256, (2, 3, 32, 48), dtype=torch.uint8) for name in ("frame1", "frame2")}
    batch = {**frames, "flow": torch.randn(2, 2, 32, 48), "valid": torch.rand(2, 1, 32, 48) < 0.7}
    module = FlowModule(options, LossOptions(l1_steps=0, blend_steps=0, coarser_weight=0.5), guidance=quiet)
    module.net.eval()
    output, loss = module.forward_loss(batch, 10)
    coarse4, coarse2, full = module.net.forward_scales(module._input(batch["frame1"], batch["frame2"]))
    assert torch.equal(full, output)
    expected = module.objective(full, batch, 10)
    for weight, scale in ((0.5, coarse2), (0.25, coarse4)):
        cells, side = scale.shape[-2:], 32 // scale.shape[-2]
        share = torch.nn.functional.avg_pool2d(batch["valid"].float(), side)
        total = torch.nn.functional.avg_pool2d(torch.where(batch["valid"], batch["flow"], 0.0), side)
        truth = {"flow": total / share.clamp_min(1e-6), "valid": share >= 0.5}
        assert truth["flow"].shape[-2:] == cells
        expected = expected + weight * module.objective(scale, truth, 10)
    torch.testing.assert_close(loss, expected)
    loss.backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in module.net.parameters())
    with pytest.raises(ValueError, match="multiples of 16"):
        module.forward_loss({name: x[..., :40] for name, x in batch.items()}, 10)
