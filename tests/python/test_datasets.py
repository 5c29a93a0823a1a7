# SPDX-License-Identifier: MIT
"""Every data set on a small tree in its true layout and formats; wrong roots."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

import data_trees as trees

from ajna.data.benchmarks import Middlebury, Sintel, Spring
from ajna.data.chairs import FlyingChairs, FlyingChairs2
from ajna.data.dataset import limited
from ajna.data.driving import HD1K, Kitti2012, Kitti2015
from ajna.data.frame_pair import FramePair, Truth
from ajna.data.registry import open_dataset
from ajna.data.things import FlyingThings3D

make, Tree, TREES = trees.make, trees.Tree, trees.TREES


def same(pair: FramePair, tree: Any, frame1: str, frame2: str, flow: str, occlusion: str = "", **masks: str) -> None:
    """The pair is what was written under these names; masks: invalid, boundary."""
    assert np.array_equal(pair.frame1, tree.images[frame1]) and np.array_equal(pair.frame2, tree.images[frame2])
    assert pair.truth is not None
    same_truth(pair.truth, tree, flow, occlusion, **masks)


def same_truth(
    truth: Truth | None, tree: Any, flow: str, occlusion: str = "", invalid: str = "", boundary: str = ""
) -> None:
    assert truth is not None
    expected, valid = tree.flows[flow]
    if invalid:
        valid = valid & ~tree.masks[invalid]
    assert np.array_equal(truth.valid, valid) and truth.valid.dtype == bool
    assert np.array_equal(truth.flow, np.where(valid[..., None], expected, 0)) and truth.flow.dtype == np.float32
    for given, name in ((truth.occlusion, occlusion), (truth.motion_boundary, boundary)):
        if name:
            assert given is not None and np.array_equal(given, tree.masks[name])
        else:
            assert given is None


# --- one by one ----------------------------------------------------------------------------------------------------


def test_chairs2(tmp_path: Path) -> None:
    t = make("chairs2", tmp_path)
    data = FlyingChairs2(tmp_path)
    assert data.names == ("0000000", "0000003") and len(data) == 2
    one, two = "train/0000000", "train/0000003"
    same(
        data[0],
        t,
        f"{one}-img_0.png",
        f"{one}-img_1.png",
        f"{one}-flow_01.flo",
        f"{one}-occ_01.png",
        boundary=f"{one}-mb_01.png",
    )
    same(data[1], t, f"{two}-img_0.png", f"{two}-img_1.png", f"{two}-flow_01.flo")
    assert data.parts(0) == {"flow", "occlusion", "motion_boundary"} and data.parts(1) == {"flow"}
    assert FlyingChairs2(tmp_path, "val").names == ("0000001",)
    assert FlyingChairs2(tmp_path, "all").names == ("train/0000000", "train/0000003", "val/0000001")
    both = FlyingChairs2(tmp_path, direction="both", backward=True)
    assert both.names == ("0000000", "0000003", "0000000_b", "0000003_b")
    back = both[2]
    same(
        back,
        t,
        f"{one}-img_1.png",
        f"{one}-img_0.png",
        f"{one}-flow_10.flo",
        f"{one}-occ_10.png",
        boundary=f"{one}-mb_10.png",
    )
    same_truth(back.backward, t, f"{one}-flow_01.flo", f"{one}-occ_01.png", boundary=f"{one}-mb_01.png")
    swapped = both[0].swapped()
    assert all(np.array_equal(getattr(swapped, k), getattr(back, k)) for k in ("frame1", "frame2", "flow", "valid"))
    assert np.array_equal(swapped.swapped().flow, both[0].flow)
    with pytest.raises(ValueError, match="'0000000' has no backward ground truth"):
        data[0].swapped()
    small = both[0].resized(10, 6)
    assert small.backward is not None and small.backward.flow.shape == (6, 10, 2)
    assert np.allclose(small.backward.flow, both[0].backward.flow[1::2, 1::2] / 2)


def test_chairs_and_its_split_file(tmp_path: Path) -> None:
    t = make("chairs", tmp_path)
    base = "FlyingChairs_release"
    data = FlyingChairs(tmp_path)
    assert data.names == ("00001", "00003") and FlyingChairs(tmp_path / base, "val").names == ("00002",)
    same(data[1], t, *(f"{base}/data/00003_{part}" for part in ("img1.ppm", "img2.ppm", "flow.flo")))
    split = tmp_path / base / "FlyingChairs_train_val.txt"
    split.write_text("1\n2\n")
    with pytest.raises(ValueError, match="has 2 entries, but .*holds 3 pairs"):
        FlyingChairs(tmp_path)
    split.write_text("1\n2\n3\n")
    with pytest.raises(ValueError, match="has '3' as its entry 3; give 1 or 2"):
        FlyingChairs(tmp_path)
    split.write_text("1 1 1")
    with pytest.raises(ValueError, match="puts no pair of .* into 'val'"):
        FlyingChairs(tmp_path, "val")
    split.unlink()
    with pytest.raises(FileNotFoundError, match="split file '.*FlyingChairs_train_val.txt' is missing"):
        FlyingChairs(tmp_path)
    assert len(FlyingChairs(tmp_path, "all")) == 3


def test_things3d_full(tmp_path: Path) -> None:
    t = make("things3d", tmp_path)
    data = FlyingThings3D(tmp_path)
    assert data.names == tuple(f"clean/{s}/left/{n}/future" for s in ("A/0000", "B/0011") for n in ("0006", "0007"))
    frames, flows = "frames_cleanpass/TRAIN/A/0000/left", "optical_flow/TRAIN/A/0000"
    first = f"{flows}/into_future/left/OpticalFlowIntoFuture_0006_L.pfm"
    same(
        data[0], t, f"{frames}/0006.png", f"{frames}/0007.png", first,
        boundary="motion_boundaries/TRAIN/A/0000/into_future/left/0006.png",
    )  # fmt: skip
    past = FlyingThings3D(tmp_path, "test", "final", "right", "past", backward=True)
    assert past.names == ("final/A/0000/right/0007/past", "final/A/0000/right/0008/past")
    frames, flows = "frames_finalpass/TEST/A/0000/right", "optical_flow/TEST/A/0000"
    last = f"{flows}/into_past/right/OpticalFlowIntoPast_0008_R.pfm"
    same(past[1], t, f"{frames}/0008.png", f"{frames}/0007.png", last)
    same_truth(past[1].backward, t, f"{flows}/into_future/right/OpticalFlowIntoFuture_0007_R.pfm")
    assert len(FlyingThings3D(tmp_path, "train", "both", "both", "both")) == 2 * 2 * 2 * 4


def test_things3d_bad_sample_list(tmp_path: Path) -> None:
    make("things3d", tmp_path)
    bad = tmp_path / "all_unused_files.txt"
    bad.write_text("TRAIN/A/0000/left/0008.png\nTRAIN/B/0011/left/0007.png\nTEST/C/0001/right/0006.png\n")
    assert FlyingThings3D(tmp_path, bad_samples=bad).names == ("clean/A/0000/left/0006/future",)
    bad.write_text("A/0000\n")
    with pytest.raises(ValueError, match="has the line 'A/0000'; each line must look like TRAIN/A/0000/left/0006.png"):
        FlyingThings3D(tmp_path, bad_samples=bad)
    with pytest.raises(FileNotFoundError, match="list of bad samples '.*none.txt' does not exist"):
        FlyingThings3D(tmp_path, bad_samples=tmp_path / "none.txt")
    bad.write_text("".join(f"TRAIN/{scene}/left/0007.png\n" for scene in ("A/0000", "B/0011")))
    with pytest.raises(ValueError, match="leaves no pair"):
        FlyingThings3D(tmp_path, bad_samples=bad)


def test_things3d_subset(tmp_path: Path) -> None:
    t = Tree(tmp_path / "FlyingThings3D_subset")
    trees.things_subset(t)
    data = FlyingThings3D(tmp_path, direction="both", backward=True)
    assert data.names == (
        *(f"clean/left/{n:07d}/future" for n in (0, 1, 10)),
        *(f"clean/left/{n:07d}/past" for n in (1, 2, 11)),
    )
    images, flows = "train/image_clean/left", "train/flow/left"
    hidden = "train/flow_occlusions/left/into_future/0000010.png"
    first, last = f"{images}/0000010.png", f"{images}/0000011.png"
    same(data[2], t, first, last, f"{flows}/into_future/0000010.flo", hidden)
    same_truth(data[2].backward, t, f"{flows}/into_past/0000011.flo")
    same(data[5], t, last, first, f"{flows}/into_past/0000011.flo")
    assert len(FlyingThings3D(tmp_path, "test")) == 3
    with pytest.raises(ValueError, match="is the subset, which is already without them"):
        FlyingThings3D(tmp_path, bad_samples=tmp_path / "list.txt")
    with pytest.raises(FileNotFoundError, match="train/image_final' is missing"):
        FlyingThings3D(tmp_path, pass_name="final")


def test_sintel(tmp_path: Path) -> None:
    t = make("sintel", tmp_path)
    data = Sintel(tmp_path, pass_name="both")
    scenes = ("alley_1/frame_0001", "alley_1/frame_0002", "market_5/frame_0001")
    assert data.names == tuple(f"{p}/{scene}" for p in ("clean", "final") for scene in scenes)
    same(
        data[4], t, "training/final/alley_1/frame_0002.png", "training/final/alley_1/frame_0003.png",
        "training/flow/alley_1/frame_0002.flo", "training/occlusions/alley_1/frame_0002.png",
        invalid="training/invalid/alley_1/frame_0002.png",
    )  # fmt: skip
    test = Sintel(tmp_path, "test")[0]
    assert test.name == "clean/cave_3/frame_0001" and test.truth is None
    with pytest.raises(ValueError, match="pass_name 'albedo' is unknown; give one of clean, final, both"):
        Sintel(tmp_path, pass_name="albedo")


@pytest.mark.parametrize(("kind", "images"), [(Kitti2012, "colored_0"), (Kitti2015, "image_2")])
def test_kitti(tmp_path: Path, kind: type[Kitti2015], images: str) -> None:
    t = Tree(tmp_path)
    trees.kitti(images)(t)
    data = kind(tmp_path)
    assert data.names == ("000000", "000007")
    valid, visible = (t.flows[f"training/flow_{which}/000007_10.png"][1] for which in ("occ", "noc"))
    t.masks["hidden"] = valid & ~visible
    files = (f"training/{images}/000007_10.png", f"training/{images}/000007_11.png")
    same(data[1], t, *files, "training/flow_occ/000007_10.png", "hidden")
    same(kind(tmp_path, ground_truth="noc")[1], t, *files, "training/flow_noc/000007_10.png")
    assert kind(tmp_path, "testing")[0].truth is None
    assert images in str(kind.__doc__) or "training pairs" in str(kind.__doc__)


def test_hd1k(tmp_path: Path) -> None:
    t = make("hd1k", tmp_path)
    data = HD1K(tmp_path)
    assert data.names == ("000000_0010", "000000_0011", "000005_0000")
    images = "hd1k_input/image_2/000000_00"
    same(data[1], t, f"{images}11.png", f"{images}12.png", "hd1k_flow_gt/flow_occ/000000_0011.png")
    assert HD1K(tmp_path, "test").names == ("000001_0000",)


def test_middlebury(tmp_path: Path) -> None:
    t = make("middlebury", tmp_path)
    data = Middlebury(tmp_path)
    assert data.names == ("RubberWhale", "Venus")
    frames = "other-data/Venus/frame1"
    same(data[1], t, f"{frames}0.png", f"{frames}1.png", "other-gt-flow/Venus/flow10.flo")
    assert Middlebury(tmp_path, "eval")[0].truth is None


def test_spring(tmp_path: Path) -> None:
    t = make("spring", tmp_path)
    data = Spring(tmp_path, direction="both", camera="right", backward=True)
    assert data.names == tuple(
        f"{scene}/right/{n}"
        for scene, frames in (("0001", ("0001/FW", "0002/FW", "0002/BW", "0003/BW")), ("0047", ("0001/FW", "0002/BW")))
        for n in frames
    )
    frames, flows = "spring/train/0001/frame_right/frame_right_", "spring/train/0001/flow_"
    same(data[3], t, f"{frames}0003.png", f"{frames}0002.png", f"{flows}BW_right/flow_BW_right_0003.flo5")
    same_truth(data[3].backward, t, f"{flows}FW_right/flow_FW_right_0002.flo5")
    assert Spring(tmp_path, "test")[0].truth is None


def test_spring_says_what_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    h5py = pytest.importorskip("h5py")
    make("spring", tmp_path)
    path = tmp_path / "spring/train/0001/flow_FW_left/flow_FW_left_0001.flo5"
    with h5py.File(path, "w") as file:
        file.create_dataset("disparity", data=np.zeros((4, 4)))
    with pytest.raises(ValueError, match="flow_FW_left_0001.flo5' holds no data set 'flow'"):
        Spring(tmp_path)[0]
    with h5py.File(path, "w") as file:
        file.create_dataset("flow", data=np.zeros((4, 4)))
    with pytest.raises(ValueError, match=r"holds float64 \[4, 4\], not flow"):
        Spring(tmp_path)[0]
    path.write_bytes(b"no HDF5")
    with pytest.raises(ValueError, match="flow_FW_left_0001.flo5' is not a whole HDF5 file"):
        Spring(tmp_path)[0]
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(RuntimeError, match="need the package h5py: pip install h5py"):
        Spring(tmp_path)
    assert len(Spring(tmp_path, "test")) == 1  # frames only


def test_max_flow_makes_long_vectors_invalid(tmp_path: Path) -> None:
    t = make("chairs2", tmp_path)
    flow, _ = t.flows["train/0000000-flow_01.flo"]
    pair = FlyingChairs2(tmp_path, max_flow=5)[0]
    valid = (np.abs(flow) <= 5).all(axis=-1)
    assert 0 < valid.sum() < valid.size and np.array_equal(pair.valid, valid)
    assert np.array_equal(pair.flow, np.where(valid[..., None], flow, 0))
    assert limited(Truth(flow, np.ones_like(valid)), None).valid.all()
    with pytest.raises(ValueError, match="max_flow=-1"):
        FlyingChairs2(tmp_path, max_flow=-1)


# --- wrong roots ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "lost", "shown"),
    [
        ("chairs", "FlyingChairs_release/data", "ROOT/data/00001_img1.ppm"),
        ("chairs2", "val", "ROOT/train/0000000-flow_01.flo"),
        ("things3d", "optical_flow/TEST", "into_future/left/OpticalFlowIntoFuture_0006_L.pfm"),
        (
            "things3d",
            "frames_cleanpass/TEST",
            "ROOT/train/image_clean|ROOT/frames_cleanpass/TRAIN/A/0000/left/0006.png",
        ),
        ("sintel", "training/flow", "ROOT/training/flow/alley_1/frame_0001.flo"),
        ("sintel", "training/clean", "ROOT/training/clean/alley_1/frame_0001.png"),
        ("kitti2012", "training/colored_0", "ROOT/training/colored_0/000000_10.png"),
        ("kitti2015", "training/flow_occ", "ROOT/training/flow_occ/000000_10.png"),
        ("hd1k", "hd1k_flow_gt/flow_occ", "ROOT/hd1k_flow_gt/flow_occ/000000_0010.png"),
        ("middlebury", "other-data", "ROOT/other-data/RubberWhale/frame10.png"),
        ("spring", "spring/train", "ROOT/train/0001/frame_left/frame_left_0001.png"),
    ],
)
def test_a_missing_folder_is_named_and_the_tree_shown(tmp_path: Path, name: str, lost: str, shown: str) -> None:
    make(name, tmp_path)
    (tmp_path / lost).rename(tmp_path / "elsewhere")
    tail = "" if name in ("chairs", "spring") else lost  # those may also lie in a nested folder
    with pytest.raises(
        FileNotFoundError, match=f"folder '.*{tail}' is missing; the folders should look like this:"
    ) as error:
        open_dataset(name, tmp_path, scoring=True)
    assert any(part in str(error.value) for part in shown.split("|"))
    (tmp_path / lost).mkdir()  # there, but empty
    empties = "holds no|lacks|is missing"
    with pytest.raises(FileNotFoundError, match=empties):
        open_dataset(name, tmp_path, scoring=True)


@pytest.mark.parametrize("name", sorted(TREES))
def test_no_folder_and_an_empty_folder(tmp_path: Path, name: str) -> None:
    if name == "spring":
        pytest.importorskip("h5py")
    with pytest.raises(
        FileNotFoundError, match=r"nowhere' does not exist; the folders should look like this:\n  ROOT/"
    ):
        open_dataset(name, tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"is missing; the folders should look like this:\n  ROOT/"):
        open_dataset(name, tmp_path)
