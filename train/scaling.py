#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Train the same network on more and more samples, fit how its error falls, and say what ten times as many should buy.

python train/scaling.py --config train/configs/synthetic.yaml --steps 4000,8000,16500 --markdown docs/results.md

Each budget is a run of its own, the whole schedule (warm-up, curriculum, learning rate) stretched to it: points along
one run are compared at learning rates that have not fallen yet. Where so many runs cost too much, ``--models`` fits
finished models instead, which may well be of one run; as FILE:SAMPLES where a model went on from another's weights,
for a file counts the samples of its own run. ``--also`` names, likewise, models that are not fitted but set against
the fit. Other options go to train/train.py, as ``--trainer.precision 32-true``.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from comparison import SCORED_AT, Scored, checked_page, is_complete, run_to_end, score_model, write
from numpy.typing import NDArray

_RESAMPLES = 2000
#: keys of a training config that are counted in steps; those of `data.stages` beside them
_STEPS = (
    ("trainer", "max_steps"),
    ("model", "loss", "l1_steps"),
    ("model", "loss", "blend_steps"),
    ("model", "guidance", "heads_steps"),
    ("model", "optim", "warmup_steps"),
)


@dataclass(frozen=True)
class PowerLaw:
    """error = factor * samples ** -exponent, in pixels, with the exponent's 95 % interval over the scenes."""

    factor: float
    exponent: float
    exponent_interval: tuple[float, float]

    def at(self, samples: float) -> float:
        return self.factor * samples**-self.exponent


def main(argv: Sequence[str] | None = None) -> int:
    """Train, score, fit, print; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=Path(__file__).parent / "configs" / "synthetic.yaml")
    parser.add_argument("--steps", default="4000,8000,16500", help="comma-separated lengths of the runs")
    parser.add_argument(
        "--runs", type=Path, default=Path("runs/scaling"), help="folder of the runs and of scaling.json"
    )
    parser.add_argument("--scenes", type=int, default=64, help="held-out scenes that each is scored on")
    parser.add_argument("--models", nargs="+", default=[], help="finished models to fit, in place of runs of --steps")
    parser.add_argument("--also", nargs="*", default=[], help="finished models to set against the fit")
    parser.add_argument("--markdown", type=Path, help="file whose part between the marks is replaced by the table")
    parser.add_argument("--only-score", action="store_true", help="leave out what is not complete, and train nothing")
    args, more = parser.parse_known_args(argv)
    try:
        budgets = budgets_of(args.steps)
        if args.scenes < 2:
            raise ValueError(f"--scenes {args.scenes}: give at least 2")
        if more and (args.only_score or args.models):
            option = "--only-score" if args.only_score else "--models"
            raise ValueError(f"{option} trains nothing: leave out {' '.join(more)}")
        page = checked_page(args.markdown, "scaling.py")
        if args.models:
            given = sorted((scored_as(text, args.scenes) for text in args.models), key=lambda run: run.samples)
            scored = [run for i, run in enumerate(given) if i == 0 or run.samples > given[i - 1].samples]
        else:
            scored = [score_model(folder / "model.safetensors", args.scenes) for folder in train(args, budgets, more)]
        if len(scored) < 3:
            found = "models of different samples" if args.models else f"complete runs in '{args.runs}'"
            raise ValueError(f"{len(scored)} {found}: a fit takes three lengths or more")
        law = fit([run.samples for run in scored], np.array([run.epes for run in scored]))
        others = [(label_of(split_samples(text)[0]), scored_as(text, args.scenes)) for text in args.also]
    except (ValueError, OSError) as error:
        print(f"scaling.py: {error}", file=sys.stderr)
        return 2
    what = "finished models, learning rates as they were" if args.models else "one run each, whole schedules"
    text = table(scored, law, others, args.scenes, what)
    record = {"fit": asdict(law), "runs": [asdict(run) for run in scored], "also": [asdict(run) for _, run in others]}
    write(args.runs / "scaling.json", json.dumps(record, indent=2) + "\n")
    if page is not None:
        page.put(text)
    print(text, end="")
    return 0


def split_samples(text: str) -> tuple[Path, int | None]:
    """FILE or FILE:SAMPLES of ``--models`` and ``--also``."""
    path, _, samples = text.rpartition(":")
    return (Path(path), int(samples)) if path and samples.isdecimal() else (Path(text), None)


def label_of(path: Path) -> str:
    """A model file's name, or its run's where training named it."""
    return path.parent.name if path.stem in ("model", "best") and path.parent.name else path.stem


def scored_as(text: str, scenes: int) -> Scored:
    """Scores of a finished model, counted at the samples that were given with it.

    Raises:
        FileNotFoundError, ValueError: as `score_model`.
    """
    path, samples = split_samples(text)
    run = score_model(path, scenes)
    return run if samples is None else replace(run, samples=samples)


def budgets_of(text: str) -> list[int]:
    """Lengths of ``--steps``, rising.

    Raises:
        ValueError: not three different whole numbers above 0 or more.
    """
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not all(part.isdecimal() and int(part) > 0 for part in parts) or len({int(part) for part in parts}) < 3:
        raise ValueError(f"--steps {text}: give three or more different numbers of steps, as 4000,8000,16500")
    return sorted({int(part) for part in parts})


def stretched(config: dict[str, Any], steps: int) -> dict[str, Any]:
    """A training config whose schedule is as long as ``steps``, everything in it in proportion.

    Raises:
        ValueError: the config does not say how long it is.
    """
    result = copy.deepcopy(config)
    length = result.get("trainer", {}).get("max_steps")
    if not isinstance(length, int) or length < 1:
        raise ValueError("the config has no trainer.max_steps: give the length of its schedule")
    for *parents, name in _STEPS:
        part = result
        for parent in parents:
            part = part.get(parent, {})
        if isinstance(part.get(name), int):
            part[name] = round(part[name] * steps / length)
    for stage in result.get("data", {}).get("stages", []):
        stage["from_step"] = round(stage["from_step"] * steps / length)
    if isinstance(result["trainer"].get("val_check_interval"), int):
        result["trainer"]["val_check_interval"] = min(result["trainer"]["val_check_interval"], steps)
    return result


def train(args: argparse.Namespace, budgets: Sequence[int], more: Sequence[str]) -> list[Path]:
    """Bring the runs of all budgets to their end; the folders of complete ones.

    Raises:
        ValueError: a run failed, or the config does not say how long it is.
    """
    import yaml

    config = yaml.safe_load(args.config.read_text(encoding="utf-8"))
    folders = []
    for steps in budgets:
        name = f"steps{steps}"
        if not args.only_score and not is_complete(args.runs / name):
            path = args.runs / f"{name}.yaml"
            write(path, yaml.safe_dump(stretched(config, steps), sort_keys=False))
            run_to_end(path, args.runs, name, more)
        if is_complete(args.runs / name):
            folders.append(args.runs / name)
    return folders


def fit(samples: Sequence[float], epes: NDArray[np.float64]) -> PowerLaw:
    """Least squares of log mean EPE over log samples; the interval by drawing scenes anew.

    Args:
        samples: [N]. epes: [N, scenes], pixels, the same scenes in each row.

    Raises:
        ValueError: an EPE that is no positive number.
    """
    if not (np.isfinite(epes).all() and (epes > 0).all()):
        raise ValueError("an EPE is no positive number: there is nothing to fit")
    logs = np.log(np.asarray(samples, dtype=float))

    def line(means: NDArray[np.float64]) -> tuple[float, float]:
        slope, offset = np.polyfit(logs, np.log(means), 1)
        return float(np.exp(offset)), -float(slope)

    random = np.random.default_rng(0)
    drawn = random.integers(0, epes.shape[1], (_RESAMPLES, epes.shape[1]))
    exponents = [line(epes[:, scenes].mean(axis=1))[1] for scenes in drawn]
    low, high = np.quantile(exponents, [0.025, 0.975])
    return PowerLaw(*line(epes.mean(axis=1)), (float(low), float(high)))


def table(runs: Sequence[Scored], law: PowerLaw, others: Sequence[tuple[str, Scored]], scenes: int, what: str) -> str:
    """Markdown: samples, EPE, the fit's EPE, and what ten times the largest budget should give."""
    lines = ["| samples | EPE px | of the fit | AUSE | times at boundaries |", "|---|---|---|---|---|"]
    for label, run in [("", run) for run in runs] + list(others):
        mark = f" ({label}, not fitted)" if label else ""
        ause, ratio = run.mean["ause"], run.mean["expected_boundary_ratio"]
        cells = [
            f"{run.samples:,}{mark}",
            f"{np.mean(run.epes):.2f}",
            f"{law.at(run.samples):.2f}",
        ]
        cells += ["–" if ause is None else f"{ause:.3f}", "–" if ratio is None else f"{ratio:.1f}"]
        lines.append("| " + " | ".join(cells) + " |")
    low, high = law.exponent_interval
    largest = runs[-1].samples
    width, height = SCORED_AT
    lines += [
        "",
        f"EPE = {law.factor:.3g} px · samples^-{law.exponent:.3f} (95 % interval of the exponent over the scenes "
        f"{low:.3f} to {high:.3f}): ten times the samples make the EPE {10**-law.exponent:.2f} times as large, "
        f"{law.at(10 * largest):.2f} px at {10 * largest:,}. {scenes} held-out scenes of the general preset at "
        f"{width}x{height}; {what}. A fit over so short a range says what the next step should buy, not where the "
        "error ends.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
