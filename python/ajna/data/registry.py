# SPDX-License-Identifier: MIT
"""The data sets by name, for command lines. Importing this is cheap: a class is imported when it is asked for."""

from __future__ import annotations

import difflib
import importlib
import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ajna.data.dataset import FlowDataset

_COMMON = ("root", "cases", "skip_bad")


@dataclass(frozen=True)
class Entry:
    """Where a data set's class lives, and the options with which it is scored if nothing else is said."""

    module: str
    class_name: str
    scored: Mapping[str, str] = field(default_factory=dict)

    def load(self) -> type[FlowDataset]:
        """The class."""
        return getattr(importlib.import_module(self.module), self.class_name)


DATASETS: dict[str, Entry] = {
    "pairs": Entry("ajna.data.pairs", "PairsDataset"),
    "packed": Entry("ajna.data.packed", "PackedDataset"),
    "chairs": Entry("ajna.data.chairs", "FlyingChairs", {"split": "val"}),
    "chairs2": Entry("ajna.data.chairs", "FlyingChairs2", {"split": "val"}),
    "things3d": Entry("ajna.data.things", "FlyingThings3D", {"split": "test"}),
    "sintel": Entry("ajna.data.benchmarks", "Sintel"),
    "kitti2012": Entry("ajna.data.driving", "Kitti2012"),
    "kitti2015": Entry("ajna.data.driving", "Kitti2015"),
    "hd1k": Entry("ajna.data.driving", "HD1K"),
    "middlebury": Entry("ajna.data.benchmarks", "Middlebury"),
    "spring": Entry("ajna.data.benchmarks", "Spring"),
}


def options_of(name: str) -> dict[str, inspect.Parameter]:
    """The options of a data set beyond root, cases and skip_bad."""
    parameters = inspect.signature(_entry(name).load().__init__).parameters
    return {key: value for key, value in parameters.items() if key not in (*_COMMON, "self")}


def open_dataset(
    name: str,
    root: str | Path,
    cases: Sequence[str] = (),
    skip_bad: bool = False,
    options: Mapping[str, str] | None = None,
    scoring: bool = False,
) -> FlowDataset:
    """Open a data set by its name.

    Args:
        name: a key of `DATASETS`.
        root, cases, skip_bad: see `FlowDataset`.
        options: further options as text, as they come from a command line, e.g. ``{"pass_name": "final"}``.
        scoring: begin with the part that is meant for scoring (FlyingChairs' val, FlyingThings3D's test).

    Raises:
        ValueError: an unknown name, option or value.
        FileNotFoundError: what the data set lacks.
    """
    entry = _entry(name)
    given = {**(entry.scored if scoring else {}), **(options or {})}
    known = options_of(name)
    values: dict[str, Any] = {}
    for key, text in given.items():
        if key not in known:
            raise ValueError(f"data set '{name}' has no option '{key}'; it has {', '.join(known) or 'none'}.")
        values[key] = _parse(key, text, str(known[key].annotation))
    return entry.load()(root, cases=cases, skip_bad=skip_bad, **values)  # type: ignore[call-arg]


def parse_options(assignments: Iterable[str] | None) -> dict[str, str]:
    """['split=val', ...] -> {'split': 'val', ...}.

    Raises:
        ValueError: for anything that is not KEY=VALUE, and for a key given twice.
    """
    options: dict[str, str] = {}
    for text in assignments or ():
        key, sign, value = text.partition("=")
        if not (key and sign and value):
            raise ValueError(f"option '{text}' is not KEY=VALUE; give for example --set split=val.")
        if key in options:
            raise ValueError(f"option '{key}' is given twice; give it once.")
        options[key] = value
    return options


def _entry(name: str) -> Entry:
    if name not in DATASETS:
        near = difflib.get_close_matches(name, DATASETS, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(DATASETS)}."
        raise ValueError(f"data set '{name}' is unknown; {hint}")
    return DATASETS[name]


def _parse(key: str, text: str, annotation: str) -> Any:
    """Text to the type that an option is annotated with: bool, float or str."""
    if annotation == "bool":
        if text.lower() not in ("true", "false"):
            raise ValueError(f"option {key}={text} is not a yes or no; give true or false.")
        return text.lower() == "true"
    if annotation.startswith("float"):
        try:
            return float(text)
        except ValueError:
            raise ValueError(f"option {key}={text} is not a number; give for example {key}=400.") from None
    return text
