# SPDX-License-Identifier: MIT
"""Packing: what comes back, kills at every moment, damage, bad samples, the command."""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

import torch
from PIL import Image

from ajna.data import pack as pack_module
from ajna.data.chairs import FlyingChairs2
from ajna.data.frame_pair import FramePair
from ajna.data.pack import estimate, pack
from ajna.data.pack_format import layout
from ajna.data.packed import PackedDataset
from ajna.data.pairs import PairsDataset

HEIGHT, WIDTH, COUNT = 13, 21, 7  # a number of pixels that is no multiple of 8


def write_flo(path: Path, flow: np.ndarray) -> None:
    path.write_bytes(b"PIEH" + struct.pack("<ii", flow.shape[1], flow.shape[0]) + flow.astype("<f4").tobytes())


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """FlyingChairs2 of 7 pairs with everything."""
    random = np.random.default_rng(0)
    folder = tmp_path / "FlyingChairs2/train"
    folder.mkdir(parents=True)
    for number in range(COUNT):
        for image in (0, 1):
            frame = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            Image.fromarray(frame).save(folder / f"{number:07d}-img_{image}.png")
        for way in ("01", "10"):
            flow = random.normal(0, 20, (HEIGHT, WIDTH, 2)).astype(np.float32)
            flow[random.random((HEIGHT, WIDTH)) < 0.1] = 1.666e9
            write_flo(folder / f"{number:07d}-flow_{way}.flo", flow)
            for mask in ("occ", "mb"):
                pixels = np.where(random.random((HEIGHT, WIDTH)) < 0.3, 255, 0).astype(np.uint8)
                Image.fromarray(pixels).save(folder / f"{number:07d}-{mask}_{way}.png")
    return tmp_path / "FlyingChairs2"


def open_root(root: Path, **options: object) -> FlyingChairs2:
    return FlyingChairs2(root, backward=True, **options)  # type: ignore[arg-type]


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != ".lock"}


def same(packed: FramePair, pair: FramePair) -> None:
    """Equal up to the rounding of flow to float16."""
    assert packed.name == pair.name
    assert np.array_equal(packed.frame1, pair.frame1) and np.array_equal(packed.frame2, pair.frame2)
    for ours, truth in ((packed.truth, pair.truth), (packed.backward, pair.backward)):
        assert ours is not None and truth is not None
        assert ours.flow.dtype == np.float32 and np.array_equal(ours.flow, truth.flow.astype(np.float16))
        for name in ("valid", "occlusion", "motion_boundary"):
            assert np.array_equal(getattr(ours, name), getattr(truth, name)) and getattr(ours, name).dtype == bool


# --- what comes back -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [None, (10, 6)])
def test_packed_pairs_are_the_pairs(root: Path, tmp_path: Path, size: tuple[int, int] | None) -> None:
    data, out = open_root(root), tmp_path / "pack"
    ticks: list[tuple[int, int]] = []
    report = pack(data, out, size=size, chunk_samples=3, workers=2, on_progress=lambda *tick: ticks.append(tick))
    expected = estimate(data, size)
    packed = PackedDataset(out)
    assert report.samples == len(packed) == COUNT and packed.names == data.names and not report.bad
    assert report.bytes == packed.bytes == expected.bytes and expected.left_out == ()
    assert sorted(p.name for p in out.glob("*.bin")) == [f"chunk-0000{n}.bin" for n in range(3)]
    assert ticks == sorted(ticks) and ticks[-1] == (COUNT, COUNT)
    for index in range(COUNT):
        same(packed[index], data[index] if size is None else data[index].resized(*size))
    packed.verify()
    assert packed.size == (size or (WIDTH, HEIGHT)) and packed.parts(0) == data.parts(0)
    assert PackedDataset(out, ["0000005", "0000001"])[1].name == "0000001"


def test_batches_are_the_pairs_from_the_file_and_from_memory(root: Path, tmp_path: Path) -> None:
    pack(open_root(root), tmp_path / "pack", chunk_samples=2)
    packed = PackedDataset(tmp_path / "pack", max_flow=15)
    resident = packed.resident("cpu")
    order = [6, 0, 3]
    batch, other = packed.batch(order), resident.batch(torch.tensor(order))
    assert set(batch) == set(other) and len(resident) == COUNT
    assert batch["frame1"].shape == (3, 3, HEIGHT, WIDTH) and batch["frame1"].dtype == torch.uint8
    assert batch["frame1"].stride(1) == 1  # channels last
    for key, tensor in batch.items():
        assert torch.equal(tensor, other[key]), key
    for row, index in enumerate(order):
        pair = packed[index]
        assert pair.truth is not None and pair.backward is not None and 0 < pair.truth.valid.mean() < 0.95
        for prefix, truth in (("", pair.truth), ("backward_", pair.backward)):
            assert torch.equal(batch[f"{prefix}flow"][row].permute(1, 2, 0), torch.from_numpy(truth.flow))
            for name in ("valid", "occlusion", "motion_boundary"):
                mask = batch[f"{prefix}{name}"][row]
                assert mask.shape == (1, HEIGHT, WIDTH) and np.array_equal(mask[0], getattr(truth, name))
        for name in ("frame1", "frame2"):
            assert np.array_equal(batch[name][row].permute(1, 2, 0), getattr(pair, name))
    with pytest.raises(ValueError, match="a batch of no samples"):
        packed.batch([])
    assert np.array_equal(pickle.loads(pickle.dumps(packed))[2].frame1, packed[2].frame1)


def test_vectors_beyond_float16_become_invalid() -> None:
    flow = np.zeros((2, 3, 2), np.float32)
    flow[0, 0], flow[1, 2] = (70000, 1), (3, -65504)
    frame = np.zeros((2, 3, 3), np.uint8)
    form = layout(3, 2, ("flow",))
    assert form.bytes % 64 == 0 and all(item.offset % 64 == 0 for item in form.fields)
    back = form.decode(form.encode(FramePair("x", frame, frame, flow, np.ones((2, 3), bool))), "x")
    assert back.truth is not None and not back.truth.valid[0, 0] and back.truth.valid.sum() == 5
    assert tuple(back.truth.flow[1, 2]) == (3, -65504) and tuple(back.truth.flow[0, 0]) == (0, 0)


def test_sizes_may_differ_but_make_no_batch(tmp_path: Path) -> None:
    for case, (width, height) in {"a": (8, 6), "b": (9, 5)}.items():
        folder = tmp_path / "pairs" / case
        folder.mkdir(parents=True)
        for number in (1, 2):
            Image.fromarray(np.full((height, width, 3), number, np.uint8)).save(folder / f"img{number}.png")
        write_flo(folder / "flow.flo", np.ones((height, width, 2), np.float32))
    Image.fromarray(np.zeros((6, 8), np.uint8)).save(tmp_path / "pairs/a/occ.png")
    data = PairsDataset(tmp_path / "pairs")
    assert estimate(data).left_out == ("occlusion",)
    pack(data, tmp_path / "pack")
    packed = PackedDataset(tmp_path / "pack")
    assert [pair.size for pair in packed.pairs()] == [(8, 6), (9, 5)] and packed.size is None
    assert packed[0].occlusion is None
    with pytest.raises(ValueError, match="holds pairs of several sizes, which make no batch; pack it with a size"):
        packed.batch([0])
    (tmp_path / "pairs/b/flow.flo").unlink()
    with pytest.raises(ValueError, match="has samples without ground truth"):
        pack(PairsDataset(tmp_path / "pairs"), tmp_path / "other")


# --- kills ---------------------------------------------------------------------------------------------------------


def kill_at(calls: list[int]) -> Callable[..., None]:
    """An os.replace that kills its process before (even) or after (odd) the n-th call."""
    real, moment = os.replace, calls[0]

    def replace(source: str, target: str) -> None:
        if calls[1] * 2 == moment:
            os.kill(os.getpid(), signal.SIGKILL)
        real(source, target)
        if calls[1] * 2 + 1 == moment:
            os.kill(os.getpid(), signal.SIGKILL)
        calls[1] += 1

    return replace


def test_a_kill_at_any_commit_loses_at_most_one_chunk(root: Path, tmp_path: Path) -> None:
    straight = tmp_path / "straight"
    pack(open_root(root), straight, chunk_samples=3, workers=1)
    commits = 2 + 2 * 3  # pack.json twice, records and index of three chunks
    for moment in range(2 * commits):
        out = tmp_path / f"killed-{moment}"
        child = os.fork()
        if child == 0:
            try:
                os.replace = kill_at([moment, 0])  # type: ignore[assignment]
                pack(open_root(root), out, chunk_samples=3, workers=1)
            finally:
                os._exit(0)  # never back into pytest
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        if moment < 2 * commits - 1:
            with pytest.raises((ValueError, FileNotFoundError), match="is unfinished; run the same|holds no pack"):
                PackedDataset(out)
        complete = len(list(out.glob("chunk-*.json")))
        report = pack(open_root(root), out, chunk_samples=3, workers=2)
        assert report.resumed == min(3 * complete, COUNT) and content(out) == content(straight)
    assert report.resumed == COUNT  # the last kill came after the end


def test_a_killed_command_goes_on(root: Path, tmp_path: Path) -> None:
    """The real command in a process of its own, killed in the middle of a chunk."""
    out, script = tmp_path / "pack", Path(__file__).resolve().parents[2] / "train/pack.py"
    arguments = ["--dataset", "chairs2", "--root", str(root), "--set", "backward=true", "--chunk", "2"]
    arguments += ["--out", str(out)]
    # Reading blocks for good at the sixth sample: the kill meets the third chunk half written, at any speed.
    slow = (
        "import sys, threading, runpy\n"
        "from ajna.data.files import FilesDataset\n"
        "read = FilesDataset.read\n"
        "FilesDataset.read = lambda self, i: threading.Event().wait() if i == 5 else read(self, i)\n"
        f"sys.argv = ['pack.py', *{arguments!r}, '--workers', '1']\n"
        f"runpy.run_path({str(script)!r}, run_name='__main__')\n"
    )
    process = subprocess.Popen([sys.executable, "-c", slow], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while not (out / "chunk-00002.bin.tmp").exists():
            assert process.poll() is None
            time.sleep(0.05)
    finally:
        process.kill()
        process.wait()
    assert json.loads((out / "pack.json").read_text())["complete"] is False
    done = subprocess.run([sys.executable, str(script), *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "7 samples with flow, occlusion, motion_boundary, backward_flow" in done.stdout
    assert "packed 7 samples, 4 of them from before" in done.stdout
    data = open_root(root)
    for index, pair in enumerate(PackedDataset(out).pairs()):
        same(pair, data[index])
    assert not list(out.glob("*.tmp"))


# --- other folders, other options, other files ---------------------------------------------------------------------


def test_a_pack_is_not_mixed_with_another(root: Path, tmp_path: Path) -> None:
    out, data = tmp_path / "pack", open_root(root)
    pack(data, out, source={"dataset": "chairs2"}, chunk_samples=3)
    for options, message in (
        ({"size": (10, 6)}, r"holds a pack with size None, not \[10, 6\]; choose another folder"),
        ({"chunk_samples": 2}, "with chunk_samples 3, not 2"),
        ({"source": {"dataset": "pairs"}}, "with source .*chairs2.*, not .*pairs"),
    ):
        with pytest.raises(ValueError, match=message):
            pack(data, out, **{"source": {"dataset": "chairs2"}, "chunk_samples": 3, **options})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="with samples 7, not 1"):
        pack(open_root(root, cases=["0000001"]), out, source={"dataset": "chairs2"}, chunk_samples=3)
    with pytest.raises(ValueError, match="holds 'train' but no pack; choose a new or an empty folder"):
        pack(data, root)
    with pytest.raises(ValueError, match="chunk_samples=0"):
        pack(data, out, chunk_samples=0)
    with pack_module._lock(out), pytest.raises(RuntimeError, match="another process packs into"):
        pack(data, out, source={"dataset": "chairs2"}, chunk_samples=3)


def test_a_changed_source_is_packed_anew(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "pack"
    pack(open_root(root), out, chunk_samples=3)
    Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(root / "train/0000004-img_0.png")
    report = pack(open_root(root), out, chunk_samples=3)
    assert report.resumed == 4 and not PackedDataset(out)[4].frame1.any()


def test_a_full_disk_is_foreseen(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(pack_module.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(RuntimeError, match="the pack needs .* GiB more, but .* has 0.0 GiB free; make room"):
        pack(open_root(root), tmp_path / "pack")


# --- damage --------------------------------------------------------------------------------------------------------


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("file", "damage", "message"),
    [
        (
            "chunk-00001.bin",
            lambda p: p.write_bytes(p.read_bytes()[:-1]),
            r"'chunk-00001.bin' \(it has \d+ bytes instead",
        ),
        ("chunk-00001.bin", Path.unlink, "the file is missing"),
        ("chunk-00001.json", Path.unlink, "its index is missing or damaged"),
        ("chunk-00001.json", lambda p: p.write_text(p.read_text().replace("0000004", "0000005")), "another checksum"),
        ("chunk-00001.json", lambda p: p.write_text("{"), "its index is missing or damaged"),
        ("pack.json", lambda p: p.write_text("["), "pack.json' is damaged"),
        ("pack.json", lambda p: p.write_text("{}"), "does not describe a pack of ajna"),
        ("pack.json", lambda p: p.write_text(p.read_text().replace('"version": 1', '"version": 9')), "has version 9"),
        ("pack.json", lambda p: p.write_text(p.read_text().replace('"parts"', '"party"')), "it lacks 'parts'"),
    ],
)
def test_a_damaged_pack_does_not_open(
    root: Path, tmp_path: Path, file: str, damage: Callable[[Path], None], message: str
) -> None:
    out = tmp_path / "pack"
    pack(open_root(root), out, chunk_samples=3)
    damage(out / file)
    with pytest.raises(ValueError, match=message):
        PackedDataset(out)
    if file.startswith("chunk"):  # what the message advises
        (out / "chunk-00001.json").unlink(missing_ok=True)
        assert pack(open_root(root), out, chunk_samples=3).resumed == 4
        PackedDataset(out).verify()


def test_a_changed_bit_is_found_on_reading_and_by_verify(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "pack"
    pack(open_root(root), out, chunk_samples=3)
    flip(out / "chunk-00001.bin")
    advice = "is damaged in 'chunk-00001.bin' .*delete 'chunk-00001.json' and run the packing command again"
    packed = PackedDataset(out)
    with pytest.raises(ValueError, match=advice):
        packed.verify()
    with pytest.raises(ValueError, match="case '0000004' has another checksum.*"):
        packed[4]
    with pytest.raises(ValueError, match=advice):
        packed.batch([0, 4])
    assert [pair.name for pair in PackedDataset(out, skip_bad=True).pairs()] == [
        n for n in packed.names if n != "0000004"
    ]


# --- bad samples and the command -----------------------------------------------------------------------------------


def load_script() -> Callable[[list[str]], int]:
    spec = importlib.util.spec_from_file_location("pack_script", Path(__file__).resolve().parents[2] / "train/pack.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def test_bad_samples_stop_or_are_listed(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nan = root / "train/0000004-flow_01.flo"
    good = nan.read_bytes()
    write_flo(nan, np.full((HEIGHT, WIDTH, 2), np.nan))
    lost = root / "train/0000006-img_1.png"
    kept = lost.read_bytes()
    lost.unlink()
    main, out = load_script(), tmp_path / "pack"
    base = ["--dataset", "chairs2", "--root", str(root), "--chunk", "3", "--out", str(out)]
    assert main(base) == 2 and "0000006-img_1.png'; get a complete copy" in capsys.readouterr().err
    lost.write_bytes(kept)
    assert main(base) == 2 and "0000004-flow_01.flo' is not finite" in capsys.readouterr().err
    assert not list(out.glob("*.tmp")) and (out / "chunk-00000.json").exists()
    lost.unlink()
    assert main([*base, "--skip-bad"]) == 0
    shown = capsys.readouterr().out
    assert "packed 5 samples, 3 of them from before" in shown and "left out 2 bad samples:" in shown
    assert f"0000004: flow file '{nan}' is not finite" in shown and f"lacks '{lost}'" in shown
    packed = PackedDataset(out)
    assert list(packed.packed_bad) == ["0000004", "0000006"] and packed.names[-1] == "0000005"
    # Repaired: only the chunks that lacked something are packed anew.
    nan.write_bytes(good)
    lost.write_bytes(kept)
    assert main(base) == 0 and "packed 7 samples, 3 of them from before" in capsys.readouterr().out
    assert not PackedDataset(out).packed_bad
    assert main(["--verify", "--out", str(out)]) == 0 and "is whole: 7 samples" in capsys.readouterr().out
    flip(out / "chunk-00002.bin")
    assert main(["--verify", "--out", str(out)]) == 2 and "damaged in 'chunk-00002.bin'" in capsys.readouterr().err


def test_the_command_estimates_first_and_names_what_is_missing(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main, out = load_script(), tmp_path / "pack"
    base = ["--dataset", "chairs2", "--root", str(root), "--out", str(out)]
    assert main([*base, "--dry-run", "--size", "320x240"]) == 0
    expected = estimate(FlyingChairs2(root), (320, 240)).bytes
    assert expected == COUNT * layout(320, 240, ("flow", "occlusion", "motion_boundary")).bytes
    assert f"{expected / 2**20:.1f} MiB in" in capsys.readouterr().out and not out.exists()
    for wrong, message in (
        (["--out", str(out)], "what to pack is missing: give --dataset and --root"),
        ([*base, "--size", "small"], "size 'small' is not WIDTHxHEIGHT"),
        (["--verify", "--out", str(tmp_path)], "holds no pack (no pack.json)"),
        (["--dataset", "chairs3", *base[2:]], "data set 'chairs3' is unknown; did you mean 'chairs'?"),
    ):
        assert main(wrong) == 2
        assert message in capsys.readouterr().err
    for path in (root / "train").glob("*.flo"):
        write_flo(path, np.full((HEIGHT, WIDTH, 2), np.inf))
    assert main([*base, "--skip-bad"]) == 2
    assert "no sample of" in capsys.readouterr().err
