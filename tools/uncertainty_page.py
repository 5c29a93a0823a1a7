#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Renew what docs/uncertainty.md shows of the shipped model: its tables, its pictures, and the notebook.

python tools/uncertainty_page.py [--pairs DIR] [--members-from DIR]

Run it after the model in the package has changed. The tables stand between markers in the page and come from
`ajna bench uncertainty`; everything else in the page is left alone. Without --pairs the table of real pairs goes, since
it would be another model's.
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "notebooks" / "02_uncertainty_maps.ipynb"
SCENES = {"boundaries": 0, "flat": 6, "occlusion": 9}  # picture -> scene of the notebook's set
NOTEBOOK_SEED = 1
WIDTH = 960  # pixels of a picture
EXTREME_CASE = "sintel_market5_final_0002"


def replace_block(text: str, name: str, block: str) -> str:
    """`text` with everything between the two markers of `name` replaced.

    Raises:
        ValueError: the markers are not there, once each.
    """
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    if text.count(start) != 1 or text.count(end) != 1 or text.index(start) > text.index(end):
        raise ValueError(f"the page must hold '{start}' and, after it, '{end}', once each.")
    return re.sub(f"{start}.*?{end}", lambda _: f"{start}\n{block}{end}", text, flags=re.DOTALL)


def measured(arguments: Sequence[str], hide: Sequence[Path | None]) -> str:
    """The table of `ajna bench uncertainty` with these arguments, below the command; folders of `hide` become DIR."""
    from ajna.cli import main as ajna

    with tempfile.TemporaryDirectory() as folder:
        command = ["bench", "uncertainty", *arguments, "--out", folder]
        if code := ajna(command):
            raise SystemExit(code)
        table = (Path(folder) / "uncertainty.md").read_text()
    secret = {str(path) for path in hide if path is not None}
    shown = shlex.join(["ajna", "bench", "uncertainty", *("DIR" if part in secret else part for part in arguments)])
    for path in hide:
        if path is not None:
            table = table.replace(f" in {path.name},", ",")
    return f"`{shown}`\n\n{table}"


def draw(folder: Path, model_name: str) -> None:
    """The pictures of the page. A palette would be smaller, and lose the rare colours: the ends of the scale."""
    from PIL import Image

    import ajna
    from ajna import plots
    from ajna.data.synthetic import SyntheticScenes

    model = ajna.load(model_name)
    scenes = SyntheticScenes(max(SCENES.values()) + 1, seed=NOTEBOOK_SEED)
    for name, index in SCENES.items():
        pair = scenes[index]
        panel = plots.uncertainty_panel(pair, model(pair.frame1, pair.frame2), width=WIDTH)
        Image.fromarray(panel).save(folder / f"uncertainty_{name}.png", optimize=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 when all is renewed, else what failed says why."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=Path, help="folder of real pairs for a second table")
    parser.add_argument("--members-from", type=Path, help="folder of training runs: the ensemble's members")
    parser.add_argument("--model", default="best", help="model by name or file (default: best)")
    parser.add_argument("--scenes", type=int, default=16, help="generated scenes of the table (default: 16)")
    parser.add_argument("--size", default="320x240", help="size of the scenes of the table (default: 320x240)")
    parser.add_argument("--repeats", type=int, default=3, help="timed calls per pair and method (default: 3)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: 1)")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="folder of uncertainty.md and images/")
    parser.add_argument("--no-notebook", action="store_true", help="leave notebooks/02_uncertainty_maps.ipynb alone")
    given = parser.parse_args(argv)
    page = given.docs / "uncertainty.md"
    if not page.is_file():
        print(f"page '{page}' does not exist; give its folder by --docs.", file=sys.stderr)
        return 2
    common = ["--threads", str(given.threads), "--repeats", str(given.repeats), "--size", given.size]
    if given.model != "best":
        common += ["--model", given.model]
    if given.members_from is not None:
        common += ["--members-from", str(given.members_from)]
    hide = (given.pairs, given.members_from)
    synthetic = measured(["--dataset", "synthetic", "--scenes", str(given.scenes), *common], hide)
    pairs = "Not measured for this model yet: run with `--pairs DIR`.\n"
    if given.pairs is not None:
        excluded = ["--exclude", EXTREME_CASE] if (given.pairs / EXTREME_CASE).is_dir() else []
        pairs = measured(["--dataset", "pairs", "--root", str(given.pairs), *excluded, *common], hide)
    text = replace_block(replace_block(page.read_text(), "SYNTHETIC", synthetic), "PAIRS", pairs)
    draw(given.docs / "images", given.model)
    page.write_text(text)
    if given.no_notebook:
        return 0
    sys.path.insert(0, str(Path(__file__).parent))
    import execute_notebooks  # type: ignore[import-not-found]  # a script beside this one

    return execute_notebooks.main([str(NOTEBOOK)])


if __name__ == "__main__":
    sys.exit(main())
