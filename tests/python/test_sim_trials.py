# SPDX-License-Identifier: MIT
"""Trials of the simulator in worker processes, what they leave behind, and the page that is made of it."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cv2")

from ajna.cli import main
from ajna.sim import EpisodeResult
from ajna.sim.gl import NoRenderingError, rendering_backend
from ajna.sim.report import BEGIN, END, collect, write_report
from ajna.sim.trials import Speed, TrialPlan, load_trial, run_trials, stored_trials, trial_path, write_json


@pytest.fixture
def rendering() -> None:
    try:
        rendering_backend()
    except NoRenderingError as error:
        pytest.skip(str(error))


def comparable(result: EpisodeResult) -> dict:
    record = dataclasses.asdict(result)
    del record["run_time_ms"], record["cpu_s"]
    return record


def test_workers_give_what_one_process_gives(tmp_path: Path, rendering: None) -> None:
    """occmask runs OpenCV's flow, which shares an image among threads: their number must not matter."""
    alone = run_trials(TrialPlan("pile", "occmask", 2, 0, tmp_path / "alone"))
    speed = Speed()
    shared = run_trials(TrialPlan("pile", "occmask", 2, 0, tmp_path / "shared"), workers=2, speed=speed)
    assert [comparable(result) for result in shared] == [comparable(result) for result in alone]
    assert speed.workers == 2 and speed.frames == 4 and speed.frames_per_s == pytest.approx(4 / speed.seconds)
    again = Speed()
    run_trials(TrialPlan("pile", "occmask", 2, 0, tmp_path / "shared"), workers=2, speed=again)
    assert again.frames == 0 and again.frames_per_s is None  # all from files


def test_killed_worker_is_one_sentence_and_keeps_what_is_done(tmp_path: Path, rendering: None) -> None:
    plan = TrialPlan("pile", "depth", 12, 0, tmp_path)
    known: list[int] = []

    def kill_one(result: EpisodeResult, from_file: bool) -> None:
        known.append(result.seed)
        if len(known) == 1:
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)

    with pytest.raises(RuntimeError, match=r"'pile' by 'depth' was killed .*run the same command again") as caught:
        run_trials(plan, workers=2, done=kill_one)
    assert "\n" not in str(caught.value)
    assert load_trial(plan, known[0]) is not None
    assert len(list(tmp_path.rglob("trial_*.json"))) < 12
    assert not multiprocessing.active_children()


ORPHAN = """
import multiprocessing, os, time
from concurrent.futures import ProcessPoolExecutor
from ajna.sim.trials import _end_with_parent
if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=_end_with_parent) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 300).result()
"""


def runs(pid: int) -> bool:
    """Whether a process runs; one that has ended and that nobody has asked for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    script = tmp_path / "orphan.py"
    script.write_text(ORPHAN)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        assert runs(worker)
        parent.terminate()
        parent.wait()
    end = time.monotonic() + 30
    while runs(worker) and time.monotonic() < end:
        time.sleep(0.1)
    assert not runs(worker)


def test_true_depth_flies_a_world_once(tmp_path: Path, rendering: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference of the path's length is a trial of `depth` in the same folder, flown only where it is missing."""
    from ajna.sim import trials

    flown: list[str] = []

    def short(world, method, renderer=None, watch=None, reference=None):
        name = method if isinstance(method, str) else method.name
        flown.append(name)
        return original(dataclasses.replace(world, time_limit_s=0.3), method, renderer, watch, reference)

    original = trials.run_episode
    monkeypatch.setattr(trials, "run_episode", short)
    speed = Speed()
    run_trials(TrialPlan("boxes", "blind", 1, 3, tmp_path), speed=speed)
    assert flown == ["depth", "blind"]
    assert speed.frames == 2 * 9
    run_trials(TrialPlan("boxes", "depth", 1, 3, tmp_path))
    run_trials(TrialPlan("boxes", "d435i", 1, 3, tmp_path))
    assert flown == ["depth", "blind", "d435i"]


def result_of(world: str, method: str, seed: int, success: bool) -> EpisodeResult:
    return EpisodeResult(
        world=world, method=method, seed=seed, success=success, reason="goal" if success else "collision", touched=None,
        variant=None, duration_s=2.0, frames=60, path_length_m=11.0, mean_speed_m_s=5.5, reference_path_length_m=10.0,
        run_time_ms=3.0, cpu_s=4.0, path=[(0.0, 0.0, 0.0, 1.5), (1.0, 5.0, 0.0, 1.5), (2.0, 10.0, 0.0, 1.5)],
    )  # fmt: skip


def put(out: Path, world: str, method: str, seed: int, success: bool = True, **settings: object) -> None:
    from ajna.sim.trials import _settings

    plan = TrialPlan(world, method, 1, seed, out)
    record = {"settings": {**_settings(plan), **settings}, "flown": {"date": f"2026-01-0{seed + 1}", "machine": "M"},
              "result": dataclasses.asdict(result_of(world, method, seed, success))}  # fmt: skip
    write_json(trial_path(plan, seed), record)


def test_report_of_a_folder(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out, page = tmp_path / "flights", tmp_path / "docs" / "results.md"
    for seed in range(4):
        put(out, "forest", "depth", seed, success=seed < 3)
    put(out, "gap", "midas", 0, weights=["net.onnx", 5, 6])
    put(out, "forest", "d435i", 0, format=-1)  # an old format counts for nothing
    (out / "forest" / "depth" / "trial_000009.json").write_text('{"settings": {')
    page.parent.mkdir()
    page.write_text("# Results\n\nBy hand.\n")
    (tmp_path / "docs" / "results.json").write_text('{"other": 1}')

    assert main(["bench", "report", "--out", str(out), "--markdown", str(page)]) == 0
    assert "2 rows of 5 trials" in capfd.readouterr().out
    text = page.read_text()
    assert text.startswith("# Results\n\nBy hand.\n\n" + BEGIN) and text.endswith(END + "\n")
    assert "| true depth | 4 | – | 75.0 [25.0, 100.0] | 5.0 [5.0, 5.0] |" in text
    assert "| D435i | not run |" in text and "| MiDaS | 1 |" in text
    assert "How trials ended: true depth 1 collision, 3 goal." in text
    assert "Flown 2026-01-01 to 2026-01-04 on M." in text
    assert "### dodge" not in text
    assert "| true depth | – | 15.0 |" in text  # 60 frames in 4 s; gap comes before forest
    record = json.loads((tmp_path / "docs" / "results.json").read_text())
    assert record["other"] == 1
    assert record["simulation"]["forest"][0]["measured"]["success_rate"] == 0.75

    # Written again it takes its own place, and what stands around it stays.
    page.write_text(page.read_text() + "\n## Another section\n")
    put(out, "forest", "ajna", 0)
    write_report(out, page)
    again = page.read_text()
    assert again.count(BEGIN) == again.count("### forest") == 1
    assert again.endswith(END + "\n\n## Another section\n") and again.startswith("# Results\n\nBy hand.\n")
    assert "| Ajna | 1 | 92.0 | 100.0 [100.0, 100.0] |" in again


def test_report_keeps_rows_whose_trials_are_gone(tmp_path: Path) -> None:
    """From another folder, or another machine: what the page had stays, and says which model flew."""
    first, second, page = tmp_path / "first", tmp_path / "second", tmp_path / "results.md"
    put(first, "forest", "depth", 0)
    put(first, "forest", "ajna", 0)
    put(first, "forest", "ajna-8hz", 0)
    write_report(first, page)
    record_path = page.with_suffix(".json")
    record = json.loads(record_path.read_text())
    (flown,) = [row for row in record["simulation"]["forest"] if row["method"] == "ajna-8hz"]
    assert flown["measured"]["model"].startswith("ajna-best-")
    flown["measured"]["model"], flown["cost"]["parameters"] = "ajna-best-00000000.safetensors", 1_230_000
    record["simulation"]["forest"].append("no row")
    record_path.write_text(json.dumps(record))

    put(second, "gap", "depth", 3)
    write_report(second, page)
    text = page.read_text()
    assert "### forest" in text and "### gap" in text
    assert "Flown 2026-01-01 to 2026-01-04 on M." in text
    marked = "| Ajna, planning at 8 Hz | 1 (ajna-best-00000000) |"
    (other,) = [line for line in text.splitlines() if line.startswith(marked)]
    assert "| Ajna | 1 | 92.0 |" in text
    assert other.endswith("| 1.23 |") and "A model's name behind the number of trials" in text
    write_report(second, page)  # from its own record, too
    assert page.read_text() == text
    put(second, "forest", "depth", 1, success=False)  # flown anew it replaces what was kept
    write_report(second, page)
    assert "| true depth | 1 | – | 0.0 [0.0, 0.0] |" in page.read_text()

    write_report(second, page, keep=False)
    text = page.read_text()
    assert "| Ajna | not run |" in text and "| true depth | 1 |" in text
    assert "A model's name behind" not in text


def test_report_errors(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "results.md"
    assert main(["bench", "report", "--out", str(tmp_path / "none"), "--markdown", str(page)]) == 2
    assert "fly some by ajna bench WORLD" in capfd.readouterr().err
    assert not page.exists()
    put(tmp_path, "pile", "midas", 0, weights=["one.pt", 1, 1])
    put(tmp_path, "pile", "midas", 1, weights=["two.pt", 1, 1])
    with pytest.raises(ValueError, match="trials of 2 networks"):
        stored_trials(tmp_path, "pile", "midas")
    trial_path(TrialPlan("pile", "midas", 1, 0, tmp_path), 1).unlink()
    notes = {row.method: row.note for row in collect(tmp_path)["pile"]}
    assert notes["midas"] == "" and notes["midas-s"] == "weights not given" and notes["depth"] == "not run"
    page.write_text(f"# Results\n{END}\n{BEGIN}\n")
    with pytest.raises(ValueError, match="one pair in order"):
        write_report(tmp_path, page)
    page.write_text("# Results\n")
    page.with_suffix(".json").write_text("[1]")
    with pytest.raises(ValueError, match="does not hold a record"):
        write_report(tmp_path, page)
    assert page.read_text() == "# Results\n"
