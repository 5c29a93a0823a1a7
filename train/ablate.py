#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Train variants of the network at equal samples, score them on held-out scenes, and print one table.

python train/ablate.py --config train/configs/ablation.yaml --runs runs/ablation --markdown docs/results.md

Each variant and seed is a run of train/train.py in ``--runs``; one that was interrupted goes on, one that is complete
is only scored. Scores are of scenes that no training or validation sees (``ajna study presets`` has more of them).
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

#: name -> (label, options of the network)
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "paper": ("the paper's network", {}),
    "skip": ("skip connections", {"skip_connections": True}),
    "heads": ("heads at three scales", {"scale_heads": True}),
    "skip_heads": ("skip connections and heads", {"skip_connections": True, "scale_heads": True}),
    "correlation": ("correlation volume at 1/8, radius 4", {"correlation_radius": 4}),
}
FIGURES = {"epe": ("EPE px", 2), "ause": ("AUSE", 3), "rho": ("Spearman", 2), "occlusion_auc": ("occlusion AUC", 2)}
BEGIN, END = "<!-- train/ablate.py: begin; written by the command -->", "<!-- train/ablate.py: end -->"
_SCORED_AT = (320, 240)


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
    parser.add_argument("--variants", default=",".join(VARIANTS), help="comma-separated: " + ", ".join(VARIANTS))
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
        if args.seeds < 1 or args.scenes < 2:
            raise ValueError(f"--seeds {args.seeds} --scenes {args.scenes}: give at least 1 seed and 2 scenes")
        if args.only_score and more:
            raise ValueError(f"--only-score trains nothing: leave out {' '.join(more)}")
        if args.markdown is not None:
            split_at_marks(args.markdown)
        runs = train(args, names, more)
        rows = [row for name in names if (row := score(name, runs[name], args.scenes))]
        if not rows:
            raise ValueError(f"no complete run in '{args.runs}': run without --only-score")
    except (ValueError, OSError) as error:
        print(f"ablate.py: {error}", file=sys.stderr)
        return 2
    text = table(rows, args.scenes)
    write(args.runs / "ablation.json", json.dumps([asdict(row) for row in rows], indent=2) + "\n")
    if args.markdown is not None:
        before, after = split_at_marks(args.markdown)
        write(args.markdown, f"{before}{BEGIN}\n{text}{END}{after}")
    print(text, end="")
    return 0


def chosen(text: str) -> list[str]:
    """Names of `--variants`.

    Raises:
        ValueError: an unknown one, or none.
    """
    names = [name for name in text.split(",") if name]
    for name in names:
        if name not in VARIANTS:
            raise ValueError(f"unknown variant '{name}': known are {', '.join(VARIANTS)}")
    if not names:
        raise ValueError(f"no variant given: known are {', '.join(VARIANTS)}")
    return names


def train(args: argparse.Namespace, names: Sequence[str], more: Sequence[str]) -> dict[str, list[Path]]:
    """Bring every run to its end; the folders of complete runs by variant.

    Raises:
        ValueError: a run failed.
    """
    script = Path(__file__).with_name("train.py")
    complete: dict[str, list[Path]] = {name: [] for name in names}
    for seed in range(1, args.seeds + 1):  # all variants once before the next seed: a table early
        for name in names:
            folder = args.runs / f"{name}_seed{seed}"
            done = folder / "complete"
            if not done.is_file() and not args.only_score:
                options = [f"--model.net.{key}={json.dumps(value)}" for key, value in VARIANTS[name][1].items()]
                seeds = [f"--seed_everything={seed}", f"--data.seed={seed}"]
                command = [sys.executable, str(script), "fit", "--config", str(args.config), "--resume=true"]
                command += [f"--runs={args.runs}", f"--name={folder.name}", *options, *seeds, *more]
                print(f"ablate.py: {folder.name}", file=sys.stderr)
                if subprocess.run(command, check=False).returncode != 0:
                    raise ValueError(f"the run '{folder}' failed: what it said stands above; call again to go on")
                done.touch()
            if done.is_file():
                complete[name].append(folder)
    return complete


def score(name: str, folders: Sequence[Path], scenes: int) -> Row | None:
    """Held-out scores, cost and latency of a variant's runs; None without runs."""
    import ajna
    from ajna.data.synthetic import SyntheticScenes
    from ajna.evaluation import evaluate
    from ajna.nn import count_macs, count_parameters, load_checkpoint

    width, height = _SCORED_AT
    scores, times, minutes, samples = [], [], [], set()
    for folder in folders:
        path = folder / "model.safetensors"
        net, metadata = load_checkpoint(path)
        report = evaluate(SyntheticScenes(scenes, width, height, seed=1), {name: ajna.load(path)}, size=None, repeats=1)
        result = report.methods[name]
        scores.append({figure: getattr(result.mean, figure) for figure in FIGURES})
        times += result.run_times_ms
        samples.add(int(metadata["provenance"]["samples"]))
        minutes.append(float(metadata["provenance"]["training_seconds"]) / 60)
    if not folders:
        return None
    if len(samples) > 1:
        raise ValueError(f"runs of '{name}' saw {sorted(samples)} samples: train all of them to the same step")
    return Row(
        variant=name,
        label=VARIANTS[name][0],
        parameters=count_parameters(net),
        flops=2 * count_macs(net.config, height, width),
        latency_ms=statistics.median(times),
        samples=samples.pop(),
        minutes=statistics.mean(minutes),
        scores=tuple(scores),
    )


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
    width, height = _SCORED_AT
    seeds = max(len(row.scores) for row in rows)
    lines += [
        "",
        f"{seeds} run{'s' if seeds > 1 else ''} each; {scenes} held-out scenes of the general preset at "
        f"{width}x{height}, means over the scenes"
        + (", and over the runs, whose range stands in brackets." if seeds > 1 else "."),
    ]
    return "\n".join(lines) + "\n"


def spread(values: Sequence[float], digits: int) -> str:
    """'1.20', or '1.20 [1.10, 1.30]' of several values; a dash of none."""
    if not values:
        return "–"
    text = f"{statistics.mean(values):.{digits}f}"
    return text if len(values) == 1 else f"{text} [{min(values):.{digits}f}, {max(values):.{digits}f}]"


def split_at_marks(path: Path) -> tuple[str, str]:
    """What stands before and after the marks.

    Raises:
        ValueError: the file has no marks. FileNotFoundError: there is no such file.
    """
    text = path.read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"'{path}' has no lines '{BEGIN}' and '{END}': add them where the table is to stand")
    return before, after


def write(path: Path, text: str) -> None:
    """Replace a file at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


if __name__ == "__main__":
    sys.exit(main())
