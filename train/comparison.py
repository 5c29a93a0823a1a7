# SPDX-License-Identifier: MIT
"""What scripts that compare training runs share: bringing a run to its end, scoring its model, writing a table."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ajna.data.synthetic import SyntheticScenes

_TASK = "task_"
#: figure of `ajna.evaluation.Scores` -> (heading, digits); on scenes of the tasks' presets behind `_TASK`
FIGURES = {
    "epe": ("EPE px", 2),
    "ause": ("AUSE", 3),
    "rho": ("Spearman", 2),
    "occlusion_auc": ("occlusion AUC", 2),
    "expected_boundary_ratio": ("times at boundaries", 1),
    f"{_TASK}epe": ("EPE px, task scenes", 2),
    f"{_TASK}expected_boundary_ratio": ("times at boundaries, task scenes", 1),
}
_TASKS = ("dodge", "navigate", "gap", "pile")
SCORED_AT = (320, 240)


@dataclass(frozen=True)
class Scored:
    """A model and its scores on held-out scenes: means over the scenes, and the EPE of each."""

    parameters: int
    flops: int  # at the size that is scored, 2 per multiply-add
    times_ms: tuple[float, ...]
    samples: int
    minutes: float
    mean: dict[str, float | None]
    epes: tuple[float, ...]


def run_to_end(config: Path, runs: Path, name: str, options: Sequence[str], log: Path | None = None) -> Path:
    """A run of train/train.py, begun or gone on with, in ``runs``/``name``; the folder. Nothing if it is complete.

    What it says goes to ``log``, or where the script's own output goes.

    Raises:
        ValueError: it failed.
    """
    folder = runs / name
    if not is_complete(folder):
        command = [sys.executable, str(Path(__file__).with_name("train.py")), "fit", f"--config={config}"]
        command += ["--resume=true", f"--runs={runs}", f"--name={name}", *options]
        print(f"{Path(sys.argv[0]).name}: {name}", file=sys.stderr)
        runs.mkdir(parents=True, exist_ok=True)
        with open(log, "a", encoding="utf-8") if log is not None else nullcontext() as output:
            done = subprocess.run(command, check=False, stdout=output, stderr=output)
        if done.returncode != 0:
            where = f"'{log}' has" if log is not None else "above stands"
            raise ValueError(f"the run '{folder}' failed: {where} what it said; call again to go on")
        (folder / "complete").touch()
    return folder


def is_complete(folder: Path) -> bool:
    """Whether :func:`run_to_end` has seen the end of a run."""
    return (folder / "complete").is_file()


@lru_cache
def held_out(count: int, width: int, height: int, preset: str) -> SyntheticScenes:
    """Scenes that no training or validation sees; one set for all models, as its textures take seconds to make."""
    from ajna.data.synthetic import SyntheticScenes

    return SyntheticScenes(count, width, height, seed=1, scene={"preset": preset})


def score_model(path: Path, scenes: int) -> Scored:
    """Cost of a model file, and its scores on held-out scenes.

    Raises:
        FileNotFoundError, ValueError: as `ajna.nn.load_checkpoint`.
    """
    import ajna
    from ajna.evaluation import MethodReport, evaluate, mean_scores
    from ajna.nn import count_macs, count_parameters, load_checkpoint

    width, height = SCORED_AT
    net, metadata = load_checkpoint(path)
    model = ajna.load(path)

    def scored(count: int, preset: str) -> MethodReport:
        scenes = held_out(count, width, height, preset)
        return evaluate(scenes, {"model": model}, size=None, repeats=1).methods["model"]

    result = scored(scenes, "general")
    each = -(-scenes // len(_TASKS))
    cases = {f"{task} {name}": case for task in _TASKS for name, case in scored(each, task).cases.items()}
    mean = asdict(result.mean)
    mean |= {f"{_TASK}{figure}": value for figure, value in asdict(mean_scores(cases)).items()}
    return Scored(
        parameters=count_parameters(net),
        flops=2 * count_macs(net.config, height, width),
        times_ms=tuple(result.run_times_ms),
        samples=int(metadata["provenance"]["samples"]),
        minutes=float(metadata["provenance"]["training_seconds"]) / 60,
        mean={figure: mean[figure] for figure in FIGURES},
        epes=tuple(case.epe for case in result.cases.values() if case.epe is not None),
    )


@dataclass(frozen=True)
class MarkedPage:
    """A Markdown file with a part that a script writes, between two lines of its own."""

    path: Path
    script: str

    @property
    def begin(self) -> str:
        return f"<!-- train/{self.script}: begin; written by the command -->"

    @property
    def end(self) -> str:
        return f"<!-- train/{self.script}: end -->"

    def around(self) -> tuple[str, str]:
        """What stands before and after the marks.

        Raises:
            ValueError: the file has no marks. FileNotFoundError: there is no such file.
        """
        before, begin, rest = self.path.read_text(encoding="utf-8").partition(self.begin)
        _, end, after = rest.partition(self.end)
        if not begin or not end:
            raise ValueError(
                f"'{self.path}' has no lines '{self.begin}' and '{self.end}': add them where the table is to stand"
            )
        return before, after

    def put(self, text: str) -> None:
        """Replace what stands between the marks."""
        before, after = self.around()
        write(self.path, f"{before}{self.begin}\n{text}{self.end}{after}")


def checked_page(path: Path | None, script: str) -> MarkedPage | None:
    """The page of ``--markdown`` where one is given, looked at before hours of work.

    Raises:
        ValueError, FileNotFoundError: as :meth:`MarkedPage.around`.
    """
    if path is None:
        return None
    page = MarkedPage(path, script)
    page.around()
    return page


def write(path: Path, text: str) -> None:
    """Replace a file at once."""
    from ajna.training.run_files import atomic_path

    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
