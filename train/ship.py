#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Put a trained model into the package, with its hash in its name and its card beside it.

python train/ship.py --run runs/synthetic --name best --scores scores.json --hardware "2 cores of an AMD EPYC (Zen 5)"

``scores.json`` is what ``ajna evaluate --json`` prints for the run's model.safetensors. The card is written from the
checkpoint's own metadata, the run's effective config and the scores; only the hardware and the notes are typed by hand.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

WEIGHTS = Path(__file__).resolve().parents[1] / "python" / "ajna" / "weights"
LIMIT_BYTES = 11_000_000


def card(name: str, digest: str, metadata: dict[str, Any], net: Any, config: str, scores: Any, args: Any) -> str:
    """The model card as Markdown."""
    from ajna.nn import count_macs, count_parameters, load_checkpoint

    provenance = metadata["provenance"]
    gflop = 2 * count_macs(net.config, 240, 320) / 1e9
    trained = f"{amount(provenance)} on {args.hardware}"
    if args.earlier:
        earlier = load_checkpoint(args.earlier)[1]["provenance"]
        total = {key: float(provenance[key]) + float(earlier[key]) for key in ("steps", "samples", "training_seconds")}
        trained += f", after {amount(earlier)} of an earlier run, whose weights it began with; {amount(total)} in all"
    calibration = "none: expected errors are the loss's own, and there are no intervals"
    if metadata.get("calibration") is not None:
        calibration = ", ".join(f"{key} {value}" for key, value in metadata["calibration"].provenance.items())
    lines = [
        f"# Model card: ajna-{name}-{digest}",
        "",
        f"- **Network**: {net!r}; {count_parameters(net):,} parameters; {gflop:.2f} GFLOP at 320x240.",
        f"- **Loss**: {metadata['loss']}; network output x {metadata['flow_scale']:g} = pixels.",
        f"- **Data**: {provenance.get('data', 'not recorded')}.",
        f"- **Training**: {trained}; "
        f"{provenance['skipped_steps']} steps skipped as not finite; torch {provenance['torch']}.",
        f"- **Calibration**: {calibration}.",
        "- **Licence**: MIT, as the rest of the package.",
        "",
        "## Scores",
        "",
        "Real pairs at 320x240, none of them trained on; conventions as `ajna evaluate` prints them.",
        "",
        "| method | EPE px | EPE / zero flow | AUSE | Spearman rho | occlusion AUC |",
        "|---|---|---|---|---|---|",
        *(score_row(entry) for entry in scores),
        "",
        "## Known limits",
        "",
        *(f"- {note}" for note in args.note),
        "",
        "## Effective training config",
        "",
        "```yaml",
        config.strip(),
        "```",
        "",
    ]
    return "\n".join(lines)


def amount(provenance: dict[str, Any]) -> str:
    """Steps, samples and time as a run counted them."""
    minutes = float(provenance.get("training_seconds", "nan")) / 60
    return f"{int(provenance['steps']):,} steps, {int(provenance['samples']):,} samples, {minutes:.0f} minutes"


def score_row(entry: dict[str, Any]) -> str:
    """One line of the table from one method's mean."""

    def text(key: str, form: str = ".2f") -> str:
        value = entry.get(key)
        return "–" if value is None else format(value, form)

    return (
        f"| {entry['method']} | {text('epe')} | {text('ratio', '.1%')} | {text('ause', '.3f')} | {text('rho')} "
        f"| {text('occlusion_auc')} |"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Copy, name and describe; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="run folder with model.safetensors and config.yaml")
    parser.add_argument("--name", default="best", help="name under which ajna.load finds it")
    parser.add_argument("--scores", type=Path, required=True, help="JSON of `ajna evaluate --json`")
    parser.add_argument("--hardware", required=True, help="what it was trained on")
    parser.add_argument("--earlier", type=Path, help="checkpoint whose weights the run began with")
    parser.add_argument("--into", type=Path, default=WEIGHTS, help="folder to write to")
    parser.add_argument("--note", action="append", default=[], help="a known limit; may be given several times")
    args = parser.parse_args(argv)
    try:
        ship(args)
    except (ValueError, OSError) as error:
        print(f"ship.py: {error}", file=sys.stderr)
        return 2
    return 0


def ship(args: argparse.Namespace) -> None:
    """Check everything first, then write card and weights."""
    from ajna.nn import load_checkpoint

    source = args.run / "model.safetensors"
    net, metadata = load_checkpoint(source)
    if not re.fullmatch(r"[a-z0-9_]+", args.name):
        raise ValueError(f"name '{args.name}': give lower-case letters, digits and _")
    if source.stat().st_size > LIMIT_BYTES:
        raise ValueError(f"'{source}' has {source.stat().st_size} bytes: a shipped model has at most {LIMIT_BYTES}")
    digest = hashlib.sha256(source.read_bytes()).hexdigest()[:8]
    scores = json.loads(args.scores.read_text(encoding="utf-8"))
    rows = [
        {"method": method, **(result.get("mean_without_excluded") or result["mean"])}
        for method, result in scores["methods"].items()
    ]
    # Folders of the machine that trained say nothing to a reader.
    config = "\n".join(
        line for line in (args.run / "config.yaml").read_text(encoding="utf-8").splitlines() if ": /" not in line
    )
    text = card(args.name, digest, metadata, net, config, rows, args)
    target = args.into / f"ajna-{args.name}-{digest}.safetensors"
    temporary = target.with_suffix(".tmp")
    shutil.copyfile(source, temporary)
    temporary.replace(target)
    (args.into / f"ajna-{args.name}.md").write_text(text, encoding="utf-8")
    for old in args.into.glob(f"ajna-{args.name}-*.safetensors"):
        if old != target:
            old.unlink()
    print(target)


if __name__ == "__main__":
    sys.exit(main())
