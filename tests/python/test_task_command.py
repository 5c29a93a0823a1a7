# SPDX-License-Identifier: MIT
"""``ajna task``: what it writes, and that it flies the skills that are flown."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

io = pytest.importorskip("ajna.io", reason="needs the build with vision (AJNA_WITH_VISION=ON)", exc_type=ImportError)

import ajna  # noqa: E402
from ajna import tasks  # noqa: E402
from ajna.cli import main  # noqa: E402
from ajna.model import models  # noqa: E402

SIZE = (240, 320)
FRAME = 1 / 30


def texture(seed: int) -> NDArray[np.uint8]:
    """Squares of 4 pixels."""
    grey = np.random.default_rng(seed).integers(0, 256, (SIZE[0] // 4, SIZE[1] // 4, 3), dtype=np.uint8)
    return np.kron(grey, np.ones((4, 4, 1), np.uint8))


@pytest.fixture
def folder(tmp_path: Path, frame_pair: tuple[NDArray[np.uint8], NDArray[np.uint8]]) -> Path:
    """Four frames in which everything moves on."""
    first, _ = frame_pair
    frames = tmp_path / "in"
    frames.mkdir()
    for index in range(4):
        io.write_image(frames / f"{index}.png", np.roll(first, (-2 * index, 3 * index), axis=(0, 1)))
    return frames


@pytest.mark.parametrize("skill", tasks.SKILLS)
def test_task_writes_a_picture_and_a_line_per_pair(
    skill: str, folder: Path, tmp_path: Path, tiny_checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["--out", str(out), "--model", str(tiny_checkpoint), "--size", "64x48", "--video", "--json"]
    assert main(["task", skill, str(folder), *arguments]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["skill"] == skill and summary["pairs"] == 3 and sum(summary["status"].values()) == 3
    names = {"frame_0001.png", "frame_0002.png", "frame_0003.png", "commands.jsonl", "overlay.mp4"}
    assert {file.name for file in out.iterdir()} == names
    lines = [json.loads(line) for line in (out / "commands.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == ["1.png", "2.png", "3.png"]
    assert [line["time_s"] for line in lines] == pytest.approx([FRAME, 2 * FRAME, 3 * FRAME], abs=1e-5)
    assert all(("command" in line) == (skill != "segment") for line in lines)
    assert io.VideoSource(str(out / "overlay.mp4")).frame_count == 3


def test_task_takes_images_one_by_one(folder: Path, tmp_path: Path, tiny_checkpoint: Path) -> None:
    images = [str(folder / f"{index}.png") for index in range(2)]
    out = tmp_path / "out"
    assert main(["task", "dodge", *images, "--out", str(out), "--model", str(tiny_checkpoint), "--fps", "10"]) == 0
    (line,) = [json.loads(text) for text in (out / "commands.jsonl").read_text().splitlines()]
    assert line["time_s"] == pytest.approx(0.1)
    assert io.read_image(out / "frame_0001.png").shape[1] == 2 * 2 * 320  # 320x240 unless --size says otherwise


def test_task_dodges_as_the_skill_that_is_flown(tmp_path: Path, tiny_checkpoint: Path) -> None:
    """Each line says what tasks.Skill says of the frame: its pairs span more than neighbours do."""
    frames = [texture(index) for index in range(8)]
    names = []
    for index, frame in enumerate(frames):
        names.append(str(tmp_path / f"{index}.png"))
        io.write_image(names[-1], frame)
    out = tmp_path / "out"
    assert main(["task", "dodge", *names, "--out", str(out), "--model", str(tiny_checkpoint)]) == 0
    lines = [json.loads(line) for line in (out / "commands.jsonl").read_text().splitlines()]

    options = tasks.SkillOptions()
    options.task, options.horizontal_fov_rad = "dodge", np.deg2rad(69.0)
    seen = []
    network = tasks.NetworkSignal(ajna.load(tiny_checkpoint).engine, options.horizontal_fov_rad)

    def signal(first: tasks.Snapshot, second: tasks.Snapshot, common: str) -> NDArray[np.float32]:
        seen.append(first.time_s - second.time_s)
        return network(first, second, common)

    skill = tasks.Skill(options, signal)
    outputs = [skill.plan(index * FRAME, frame) for index, frame in enumerate(frames)][1:]
    assert [line["status"] for line in lines] == [output.status for output in outputs]
    assert [line["command"] for line in lines] == [tasks.command_dict(output.command) for output in outputs]
    np.testing.assert_allclose(seen, [FRAME * span for span in (1, 2, 3, 4, 5, 5, 5)], atol=1e-9)
    assert all(output.map.shape == SIZE and output.details.status == output.status for output in outputs)


Refused = Callable[..., str]


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]) -> Refused:
    def run(*arguments: object) -> str:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        output, error = capfd.readouterr()
        assert code == 2 and output == "" and error.count("\n") == 1, error
        return error

    return run


def test_task_refuses_what_it_cannot_do(folder: Path, tmp_path: Path, tiny_checkpoint: Path, refused: Refused) -> None:
    out = tmp_path / "out"
    rest = ["--out", out, "--model", tiny_checkpoint]
    assert "did you mean 'dodge'? Known: dodge, navigate, gap, segment" in refused("task", "doge", folder, *rest)
    assert "is a single image" in refused("task", "dodge", folder / "0.png", *rest)
    assert "does not exist" in refused("task", "gap", folder / "0.png", folder / "none.png", *rest)
    (folder / "alone").mkdir()
    io.write_image(folder / "alone" / "0.png", np.zeros((48, 64, 3), np.uint8))
    assert "two frames or more" in refused("task", "segment", folder / "alone", *rest)
    assert "too few to dodge: give 2 or more (--fps)" in refused("task", "dodge", folder, *rest, "--fps", 1)
    assert not out.exists()


def test_gap_command_takes_the_motion_of_the_wall_out(tmp_path: Path) -> None:
    """The second frame is the wall shifted; the command must align it, or its map is that of a moving wall."""
    wall = texture(2)
    names = []
    for index, frame in enumerate((wall, np.roll(wall, (0, -9), (0, 1)))):
        names.append(str(tmp_path / f"{index}.png"))
        io.write_image(names[-1], frame)
    if not models():
        pytest.skip("this build ships no model")
    assert main(["task", "gap", *names, "--out", str(tmp_path / "out")]) == 0
    (line,) = (tmp_path / "out" / "commands.jsonl").read_text().splitlines()
    assert json.loads(line)["status"] == "exploring"  # a wall without a gap
