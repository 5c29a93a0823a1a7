#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Train variants of network and recipe at equal samples, score them on held-out scenes, and print one table.

python train/ablate.py --config train/configs/ablation.yaml --runs runs/ablation --markdown docs/results.md

Each variant and seed is a run of train/train.py in ``--runs``; one that was interrupted goes on, one that is complete
is only scored. Scores are of scenes that no training or validation sees (``ajna study presets`` has more of them).
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from comparison import FIGURES, SCORED_AT, checked_page, is_complete, run_to_end, score_model, write

#: name -> (label, options of train/train.py): variants of the network, all by the recipe of the config
NETWORKS: dict[str, tuple[str, dict[str, Any]]] = {
    "paper": ("the paper's network", {}),
    "skip": ("skip connections", {"model.net.skip_connections": True}),
    "heads": ("heads at three scales", {"model.net.scale_heads": True}),
    "skip_heads": (
        "skip connections and heads",
        {"model.net.skip_connections": True, "model.net.scale_heads": True},
    ),
    "correlation": ("correlation volume at 1/8, radius 4", {"model.net.correlation_radius": 4}),
    "skip_correlation": (
        "skip connections and correlation volume",
        {"model.net.skip_connections": True, "model.net.correlation_radius": 4},
    ),
}
#: likewise: the paper's network, one part of the recipe changed
RECIPES: dict[str, tuple[str, dict[str, Any]]] = {
    "general": ("scenes of the general preset alone", {"data.scene": {"bank_size": 192, "mix": {"general": 1.0}}}),
    "no_l1": ("the paper's loss alone, without L1 beside it", {"model.loss.l1_share": 0.0}),
    "half_rate": ("half the learning rate", {"model.optim.lr": 7.5e-5}),
    "double_rate": ("twice the learning rate", {"model.optim.lr": 3e-4}),
    "no_average": ("without averaged weights", {"model.optim.ema_decay": 0.0}),
}
VARIANTS = {**NETWORKS, **RECIPES}
GROUPS = {"networks": list(NETWORKS), "recipes": list(RECIPES)}


@dataclass(frozen=True)
class Row:
    """One variant: what it costs, and what each of its seeds scored."""

    variant: str
    label: str
    parameters: int
    flops: int  # at 320x240, 2 per multiply-add
    latency_ms: float  # median of the engine
    samples: int
    minutes: float  # of training, mean over the seeds
    scores: tuple[dict[str, float | None], ...]  # per seed


def main(argv: Sequence[str] | None = None) -> int:
    """Train, score, print; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=Path(__file__).parent / "configs" / "ablation.yaml")
    known = "; ".join(f"{group} ({', '.join(names)})" for group, names in GROUPS.items())
    parser.add_argument(
        "--variants", default=",".join(GROUPS), help=f"comma-separated names, or groups of them: {known}"
    )
    parser.add_argument("--jobs", type=int, default=1, help="runs at once; what each says then goes to RUNS/NAME.log")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each variant")
    parser.add_argument(
        "--runs", type=Path, default=Path("runs/ablation"), help="folder of the runs and of ablation.json"
    )
    parser.add_argument("--scenes", type=int, default=64, help="held-out scenes that each is scored on")
    parser.add_argument("--markdown", type=Path, help="file whose part between the marks is replaced by the table")
    parser.add_argument("--only-score", action="store_true", help="leave out what is not complete, and train nothing")
    args, more = parser.parse_known_args(argv)
    try:
        names = chosen(args.variants)
        if args.seeds < 1 or args.scenes < 2 or args.jobs < 1:
            given = f"--seeds {args.seeds} --scenes {args.scenes} --jobs {args.jobs}"
            raise ValueError(f"{given}: give at least 1 seed, 2 scenes and 1 job")
        if args.only_score and more:
            raise ValueError(f"--only-score trains nothing: leave out {' '.join(more)}")
        page = checked_page(args.markdown, "ablate.py")
        runs = train(args, names, more)
        rows = [row for name in names if (row := score(name, runs[name], args.scenes))]
        if not rows:
            raise ValueError(f"no complete run in '{args.runs}': run without --only-score")
        if (start := start_of(args.config)) is not None:
            rows.insert(0, start_row(start, args.scenes))
    except (ValueError, OSError) as error:
        print(f"ablate.py: {error}", file=sys.stderr)
        return 2
    text = table(rows, args.scenes)
    write(args.runs / "ablation.json", json.dumps([asdict(row) for row in rows], indent=2) + "\n")
    if page is not None:
        page.put(text)
    print(text, end="")
    return 0


def chosen(text: str) -> list[str]:
    """Names of `--variants`.

    Raises:
        ValueError: an unknown one, or none.
    """
    parts = [part for part in text.split(",") if part]
    names = list(dict.fromkeys(name for part in parts for name in GROUPS.get(part, [part])))
    for name in names:
        if name not in VARIANTS:
            raise ValueError(f"unknown variant '{name}': known are {', '.join([*GROUPS, *VARIANTS])}")
    if not names:
        raise ValueError(f"no variant given: known are {', '.join([*GROUPS, *VARIANTS])}")
    return names


def options_of(name: str) -> list[str]:
    """Options of train/train.py that make a variant."""
    return [f"--{key}={json.dumps(value)}" for key, value in VARIANTS[name][1].items()]


def train(args: argparse.Namespace, names: Sequence[str], more: Sequence[str]) -> dict[str, list[Path]]:
    """Bring every run to its end; the folders of complete runs by variant.

    Raises:
        ValueError: a run failed.
    """
    seeds = range(1, args.seeds + 1)
    if not args.only_score:
        with ThreadPoolExecutor(args.jobs) as pool:  # each waits for a process of its own
            runs = []
            for seed in seeds:  # all variants once before the next seed: a table early
                for name in names:
                    options = [*options_of(name), f"--seed_everything={seed}", f"--data.seed={seed}", *more]
                    run = f"{name}_seed{seed}"
                    log = args.runs / f"{run}.log" if args.jobs > 1 else None
                    runs.append(pool.submit(run_to_end, args.config, args.runs, run, options, log))
            for pending in runs:
                pending.result()
    folders = {name: [args.runs / f"{name}_seed{seed}" for seed in seeds] for name in names}
    return {name: [folder for folder in folders[name] if is_complete(folder)] for name in names}


def score(name: str, folders: Sequence[Path], scenes: int) -> Row | None:
    """Held-out scores, cost and latency of a variant's runs; None without runs."""
    if not folders:
        return None
    runs = [score_model(folder / "model.safetensors", scenes) for folder in folders]
    samples = {run.samples for run in runs}
    if len(samples) > 1:
        raise ValueError(f"runs of '{name}' saw {sorted(samples)} samples: train all of them to the same step")
    return Row(
        variant=name,
        label=VARIANTS[name][0],
        parameters=runs[0].parameters,
        flops=runs[0].flops,
        latency_ms=statistics.median(time for run in runs for time in run.times_ms),
        samples=samples.pop(),
        minutes=statistics.mean(run.minutes for run in runs),
        scores=tuple(run.mean for run in runs),
    )


def start_of(config: Path) -> str | None:
    """The model whose weights a config begins with, if any."""
    import yaml

    return (yaml.safe_load(config.read_text(encoding="utf-8")).get("model") or {}).get("init_from")


def start_row(name: str, scenes: int) -> Row:
    """That model as it is."""
    from ajna.model import checkpoint_path

    run = score_model(checkpoint_path(name), scenes)
    latency = statistics.median(run.times_ms)
    label = "what all begin with, not trained on"
    return Row("start", label, run.parameters, run.flops, latency, 0, 0.0, (run.mean,))


def table(rows: Sequence[Row], scenes: int) -> str:
    """Markdown: mean over the seeds, and their range where there are several."""
    head = ["variant", "M parameters", "GFLOP", "ms", "samples", "minutes", *(name for name, _ in FIGURES.values())]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        cells = [row.label, f"{row.parameters / 1e6:.2f}", f"{row.flops / 1e9:.2f}", f"{row.latency_ms:.0f}"]
        cells += [f"{row.samples:,}", f"{row.minutes:.0f}"]
        for figure, (_, digits) in FIGURES.items():
            values = [value for scores in row.scores if (value := scores[figure]) is not None]
            cells.append(spread(values, digits))
        lines.append("| " + " | ".join(cells) + " |")
    width, height = SCORED_AT
    seeds = max(len(row.scores) for row in rows)
    lines += [
        "",
        f"{seeds} run{'s' if seeds > 1 else ''} each; {scenes} held-out scenes of the general preset at "
        f"{width}x{height}, and as many of the tasks' presets, means over the scenes"
        + (", and over the runs, whose range stands in brackets." if seeds > 1 else "."),
    ]
    return "\n".join(lines) + "\n"


def spread(values: Sequence[float], digits: int) -> str:
    """'1.20', or '1.20 [1.10, 1.30]' of several values; a dash of none."""
    if not values:
        return "–"
    text = f"{statistics.mean(values):.{digits}f}"
    return text if len(values) == 1 else f"{text} [{min(values):.{digits}f}, {max(values):.{digits}f}]"


if __name__ == "__main__":
    sys.exit(main())
