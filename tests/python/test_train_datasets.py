# SPDX-License-Identifier: MIT
"""Training on data sets, part by part: order, windows, packs, masks, resume positions, refusals."""

from __future__ import annotations

import importlib.util
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lightning")
pytest.importorskip("jsonargparse")
pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

from ajna import synth
from ajna.data.chairs import FlyingChairs2
from ajna.data.frame_pair import FramePair
from ajna.data.pack import pack
from ajna.data.packed import PackedDataset
from ajna.training import DatasetData, FlowModule, LossOptions, NetOptions, OptimOptions
from ajna.training.epochs import EpochStream, PairReader, ValidationBatches, epoch_order
from ajna.training.guidance import FlowHeads
from ajna.training.windows import cropped, fitted_size, pair_tensors, scaled


def load_trees() -> ModuleType:
    path = Path(__file__).with_name("data_trees.py")
    spec = importlib.util.spec_from_file_location("data_trees", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


trees = load_trees()
COUNT = 10  # training pairs


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """FlyingChairs2 of 10 + 3 pairs, 20x12."""
    folder = tmp_path_factory.mktemp("data") / "FlyingChairs2"
    train = tuple(f"{n:07d}" for n in range(COUNT))
    trees.chairs2(trees.Tree(folder), train, ("0000100", "0000101", "0000102"))
    return folder


@pytest.fixture(scope="module")
def packs(root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("packs")
    for split in ("train", "val"):
        pack(FlyingChairs2(root, split=split), folder / split, source={"dataset": "chairs2"}, chunk_samples=4)
    return folder / "train", folder / "val"


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a.keys() == b.keys() and all(
        torch.equal(a[n], b[n]) if isinstance(a[n], torch.Tensor) else a[n] == b[n] for n in a
    )


# --- order ---------------------------------------------------------------------------------------------------------


def test_each_epoch_has_its_own_order_that_no_other_run_shares() -> None:
    orders = {(run, epoch): tuple(epoch_order(50, run, epoch)) for run in (1, 2) for epoch in range(4)}
    assert all(sorted(order) == list(range(50)) for order in orders.values())
    assert len(set(orders.values())) == len(orders)
    assert epoch_order(50, 1, 2) == list(orders[1, 2])


@pytest.mark.parametrize("world", [1, 2])
def test_ranks_share_a_step_without_overlap(root: Path, world: int) -> None:
    reader = PairReader(FlyingChairs2(root), (8, 16))
    streams = [islice(EpochStream(reader, 4, seed=1, rank=rank, world=world), 6) for rank in range(world)]
    alone = list(islice(EpochStream(reader, 4, seed=1), 6))
    for whole, *parts in zip(alone, *streams, strict=True):
        assert {name for part in parts for name in part["name"]} == set(whole["name"]) and len(whole["name"]) == 4
        assert sum(len(part["name"]) for part in parts) == 4
        assert all(torch.equal(p["flow"], whole["flow"][rank::world]) for rank, p in enumerate(parts))
    for epoch in range(3):  # two whole steps of four: eight different pairs
        assert len({name for batch in alone[2 * epoch : 2 * epoch + 2] for name in batch["name"]}) == 8
    with pytest.raises(ValueError, match=r"data.batch = 4: it cannot be shared by 3 processes"):
        EpochStream(reader, 4, seed=1, world=3)


@pytest.mark.parametrize(("start", "prefetch"), [(1, 0), (2, 2), (5, 2)])
def test_a_stream_from_any_step_continues_the_same_samples(root: Path, start: int, prefetch: int) -> None:
    reader = PairReader(FlyingChairs2(root), (8, 12), "native", workers=2)
    whole = list(islice(EpochStream(reader, 3, seed=7), 9))
    part = islice(
        EpochStream(PairReader(FlyingChairs2(root), (8, 12), "native"), 3, 7, start=start, prefetch=prefetch), 4
    )
    assert all(same(a, b) for a, b in zip(part, whole[start:], strict=False))
    # The window of a pair differs between epochs.
    first, later = (
        {n: f for b in part for n, f in zip(b["name"], b["frame1"], strict=True)} for part in (whole[:3], whole[6:])
    )
    shared = set(first) & set(later)
    assert shared and any(not torch.equal(first[name], later[name]) for name in shared)


def test_validation_is_shared_and_filled_with_what_does_not_count(root: Path) -> None:
    reader = PairReader(FlyingChairs2(root, split="val"), (8, 16))
    seen: list[str] = []
    for rank in range(2):
        batches = list(ValidationBatches(reader, 1, rank=rank, world=2))
        assert len(batches) == 2
        seen += [name for b in batches for name, valid in zip(b["name"], b["valid"], strict=True) if valid.any()]
    assert sorted(seen) == ["0000100", "0000101", "0000102"]
    again = list(ValidationBatches(reader, 8, limit=2))
    assert [batch["name"] for batch in again] == [["0000100", "0000101"]]


# --- windows -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(6, 10), (9, 13), (12, 20), (18, 31)])
def test_scaling_a_batch_is_resizing_its_pairs(root: Path, size: tuple[int, int]) -> None:
    height, width = size
    for pair in FlyingChairs2(root, backward=True, cases=["0000000"]).pairs():
        ours, theirs = scaled(pair_tensors(pair), height, width), pair_tensors(pair.resized(width, height))
        assert ours.keys() == theirs.keys() and "backward_flow" in ours
        for name in ours:
            if name.startswith("frame"):
                assert (ours[name].int() - theirs[name].int()).abs().max() <= 1  # float32 against float64
            else:
                assert torch.equal(ours[name], theirs[name]), name


@pytest.mark.parametrize(("fit", "expected"), [("cover", (240, 427)), ("resize", (240, 320)), ("native", (540, 960))])
def test_frames_are_scaled_as_fit_says(fit: str, expected: tuple[int, int]) -> None:
    assert fitted_size((540, 960), (240, 320), fit) == expected
    if fit == "native":
        with pytest.raises(ValueError, match="frames of 300x540 hold no window of 320x240"):
            fitted_size((540, 300), (240, 320), fit)


def test_windows_are_cut_where_the_seed_says() -> None:
    flow = torch.arange(2 * 2 * 9 * 11).float().view(2, 2, 9, 11)
    batch = {"flow": flow, "valid": flow[:, :1] > 3}
    places = set()
    for seed in range(40):
        cut = cropped(batch, (4, 5), [seed, seed + 1000])
        y, x = divmod(int(cut["flow"][0, 0, 0, 0]), 11)
        places.add((y, x))
        assert torch.equal(cut["flow"][0], flow[0, :, y : y + 4, x : x + 5])
        assert torch.equal(cut["valid"][0], batch["valid"][0, :, y : y + 4, x : x + 5])
    assert {y for y, _ in places} == set(range(6)) and {x for _, x in places} == set(range(7))
    assert torch.equal(cropped(batch, (4, 5))["flow"], flow[:, :, 2:6, 3:8])


def test_pairs_without_truth_are_refused() -> None:
    frame = np.zeros((4, 4, 3), np.uint8)
    with pytest.raises(ValueError, match="'x' has no ground truth"):
        pair_tensors(FramePair("x", frame, frame))


# --- the data module -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fit", ["cover", "native"])
def test_files_and_packs_and_memory_give_the_same_batches(root: Path, packs: tuple[Path, Path], fit: str) -> None:
    options: dict[str, Any] = {"size": (16, 8), "fit": fit, "batch": 3, "val_batch": 2}
    train, val = (str(path) for path in packs)
    sources = [
        DatasetData("chairs2", str(root), **options),
        DatasetData("packed", train, val, **options),
        DatasetData("packed", train, val, resident=True, **options),
    ]
    batches = [list(islice(data.stream(2), 4)) for data in sources]
    for ours, *others in zip(*batches, strict=True):
        assert ours["frame1"].shape == (3, 3, 8, 16) and ours["frame1"].dtype == torch.uint8
        assert all(same(ours, other) for other in others)
    checks = [list(ValidationBatches(data.val_reader, 2)) for data in sources]
    assert all(same(a, b) for a, b in zip(checks[0], checks[1], strict=True)) and len(checks[0]) == 2
    assert sources[0].describe() == sources[1].describe() and "FlyingChairs2, 10 pairs" in sources[0].describe()


def test_unusable_data_is_refused(root: Path, packs: tuple[Path, Path], tmp_path: Path) -> None:
    train, copy = str(packs[0]), str(tmp_path / "copy")
    pack(FlyingChairs2(root), copy)
    for arguments, message in (
        ({"dataset": "chairs2"}, "data.root is missing: give the folder of data set 'chairs2'"),
        ({"dataset": "chair2", "root": train}, "'chair2' is unknown; did you mean 'chairs2'"),
        ({"dataset": "packed", "root": train}, "data.val_root is missing"),
        ({"dataset": "packed", "root": train, "val_root": train}, "'0000000' is a training pair, too"),
        ({"dataset": "packed", "root": train, "val_root": copy}, "'0000000' is a training pair, too"),
        ({"dataset": "chairs2", "root": str(root), "val_options": {"split": "train"}}, "'0000000' is a training pair"),
        ({"dataset": "chairs2", "root": str(root), "fit": "covr"}, "data.fit = covr: did you mean 'cover'?"),
        ({"dataset": "chairs2", "root": str(root), "batch": 11}, "data.batch = 11: the data set has 10 pairs"),
        ({"dataset": "chairs2", "root": str(root), "batch": 0}, "data.batch = 0: give at least 1"),
        ({"dataset": "chairs2", "root": str(root), "resident": True}, "is no pack of one size"),
        ({"dataset": "chairs2", "root": str(root), "options": {"splitt": "val"}}, "has no option 'splitt'"),
    ):
        with pytest.raises(ValueError, match=message.replace("?", r"\?")):
            DatasetData(**{"batch": 2, **arguments})
    with pytest.raises(FileNotFoundError, match="is missing; the folders should look like this"):
        DatasetData("chairs2", str(tmp_path / "copy"))


def test_the_augmentation_gets_what_it_needs(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[dict[str, Any]] = []

    class Recorder:
        def __init__(self, options: dict[str, Any]) -> None:
            assert options == {"noise": 0.1}

        def __call__(self, batch: dict[str, Any], height: int, width: int, seed: int) -> dict[str, Any]:
            calls.append({**batch, "seed": seed})
            return {name: value[..., :height, :width] for name, value in batch.items()}

    monkeypatch.setattr(synth, "Augmenter", Recorder, raising=False)
    options: dict[str, Any] = {"size": (16, 8), "fit": "native", "batch": 2, "augment": {"noise": 0.1}}
    data = DatasetData("chairs2", str(root), options={"backward": True}, **options)
    batches = list(islice(data.stream(prefetch=0), 3))
    assert [batch["flow"].shape for batch in batches] == [(2, 2, 8, 16)] * 3
    assert set(calls[0]) == {"frame1", "frame2", "flow", "valid", "flow_backward", "valid_backward", "seed"}
    assert calls[0]["frame1"].shape == (2, 3, 12, 20) and len({call["seed"] for call in calls}) == 3
    list(ValidationBatches(data.val_reader, 2))
    assert len(calls) == 3, "what is validated is not augmented"
    monkeypatch.delattr(synth, "Augmenter")
    with pytest.raises(ValueError, match="this build has no augmentation"):
        DatasetData("chairs2", str(root), **options)


def test_bad_samples_are_replaced_and_listed(root: Path, tmp_path: Path) -> None:
    trees.chairs2(trees.Tree(tmp_path), tuple(f"{n:07d}" for n in range(4)), ("0000009",))
    (tmp_path / "train/0000002-img_0.png").write_bytes(b"\x89PNG not")
    data = DatasetData("chairs2", str(tmp_path), size=(16, 8), batch=2, skip_bad=True, workers=1)
    seen = {name for batch in islice(data.stream(), 4) for name in batch["name"]}
    assert seen == {"0000000", "0000001", "0000003"} and "0000002-img_0.png" in data.bad["0000002"]
    pack(FlyingChairs2(tmp_path, skip_bad=True), tmp_path / "pack")
    blob = tmp_path / "pack/chunk-00000.bin"
    content = bytearray(blob.read_bytes())
    content[10] ^= 1
    blob.write_bytes(content)
    packed = PairReader(PackedDataset(tmp_path / "pack", skip_bad=True), (8, 16))
    assert set(packed.batch([0, 1, 2], [1, 2, 3])["name"]) == {"0000001", "0000003"}
    assert "has another checksum" in packed.dataset.bad["0000000"]


# --- learning ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("l1_steps", [0, 10])
def test_pixels_without_truth_teach_nothing(l1_steps: int) -> None:
    module = FlowModule(NetOptions(width=4), LossOptions(l1_steps=l1_steps, blend_steps=0), flow_scale=2.0)
    output = torch.randn(2, 4, 8, 16, generator=torch.Generator().manual_seed(0)).requires_grad_()
    valid = torch.ones(2, 1, 8, 16, dtype=torch.bool)
    valid[:, :, :4] = False
    batch = {"flow": torch.ones(2, 2, 8, 16), "valid": valid}
    batch["flow"][:, :, :4] = torch.nan
    module.objective(output, batch, 0).backward()
    assert output.grad is not None and output.grad[:, :, :4].abs().sum() == 0 and (output.grad[:, :, 4:] != 0).all()
    half = output.detach()[:, :, 4:].clone().requires_grad_()
    module.objective(half, {"flow": batch["flow"][:, :, 4:]}, 0).backward()
    assert half.grad is not None and torch.allclose(half.grad, output.grad[:, :, 4:])
    with pytest.raises(ValueError, match="the data has no occlusion masks"):
        FlowModule(NetOptions(width=4), LossOptions(occluded_weight=0.5)).objective(output, batch, 0)


def test_the_heads_look_at_known_flow_only() -> None:
    torch.manual_seed(0)
    net = NetOptions(width=4).build()
    heads = FlowHeads(net)
    layers = net.forward_layers(torch.rand(1, 6, 32, 32))
    target, valid = torch.randn(1, 2, 32, 32), torch.ones(1, 1, 32, 32, dtype=torch.bool)
    assert torch.allclose(heads.loss(layers, target, valid), heads.loss(layers, target), rtol=1e-5)
    valid[..., :16] = False
    changed = target.clone()
    changed[..., :16] = torch.nan
    assert torch.equal(heads.loss(layers, changed, valid), heads.loss(layers, target, valid))


def test_schedules() -> None:
    step = OptimOptions(lr=1.0, schedule="step", warmup_steps=2, milestones=[0.5, 0.75], gamma=0.1)
    rates = [step.lr_at(n, 100) for n in range(100)]
    assert rates[:2] == [0.5, 1.0] and set(rates[2:50]) == {1.0}
    assert rates[50:75] == pytest.approx([0.1] * 25) and rates[75:] == pytest.approx([0.01] * 25)
    constant = OptimOptions(lr=1e-4, schedule="constant", warmup_steps=0)
    assert {constant.lr_at(n, 10) for n in range(20)} == {1e-4}
    for wrong in ({"schedule": "linear"}, {"milestones": [0.7, 0.3]}, {"milestones": [0.5, 2]}, {"gamma": 0.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            OptimOptions(**wrong)


def test_a_run_lasts_as_many_steps_as_its_epochs(root: Path) -> None:
    data = DatasetData("chairs2", str(root), size=(16, 8), batch=3)
    assert data.steps_per_epoch == 3
    assert data.total_steps(4, -1) == 12 and data.total_steps(4, 5) == 5 and data.total_steps(-1, 7) == 7
    with pytest.raises(ValueError, match="trainer.max_epochs = -1: give the epochs"):
        data.total_steps(-1, -1)
    with pytest.raises(ValueError, match="begun with batch = 4 of the training data, not 3"):
        data.load_state_dict({"pairs": 10, "batch": 4, "seed": 1})
