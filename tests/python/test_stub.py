# SPDX-License-Identifier: MIT
"""The type stub of the extension names what the extension has, no more and no less."""

from __future__ import annotations

import ast
from pathlib import Path

import ajna
from ajna import _core

STUB = Path(ajna.__file__).with_name("_core.pyi")
ALIASES = {"Path", "FieldTuple"}


def members(body: list[ast.stmt]) -> dict[str, ast.stmt]:
    found: dict[str, ast.stmt] = {}
    for node in body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            found[node.name] = node
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = node
    return found


def public(names: object) -> set[str]:
    return {name for name in names if not str(name).startswith("_")}  # type: ignore[attr-defined]


def test_stub_and_extension_name_the_same_things() -> None:
    stub = members(ast.parse(STUB.read_text()).body)
    expected = public(stub) - ALIASES
    if not _core.with_vision:  # io is left out of such a build
        assert public(dir(_core)) <= expected
        return
    assert public(dir(_core)) == expected
    for name, node in stub.items():
        if isinstance(node, ast.ClassDef):
            assert public(dir(getattr(_core, name))) == public(members(node.body)), name
