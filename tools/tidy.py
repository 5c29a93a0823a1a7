# SPDX-License-Identifier: MIT
"""clang-tidy over the C++ libraries and applications, in parallel, remembering what passed.

tidy.py COMPILE_COMMANDS: LibTorch's headers cost about ten seconds a file, so a file whose content, headers of ours,
flags, checks and tools are as they were when it last passed is skipped ($XDG_CACHE_HOME/ajna/clang-tidy). Tests,
benchmarks and bindings (conversions only) are left to the compiler's warnings.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ajna" / "clang-tidy"
INCLUDE = re.compile(rb'^\s*#\s*include\s*"([^"]+)"', re.MULTILINE)


def our_files(source: Path, seen: dict[Path, bytes]) -> dict[Path, bytes]:
    """`source` and every header of this project that it includes, directly or not, with their contents."""
    if source in seen:
        return seen
    seen[source] = source.read_bytes()
    for name in INCLUDE.findall(seen[source]):
        for folder in (source.parent, ROOT / "cpp"):
            header = folder / name.decode()
            if header.is_file():
                our_files(header.resolve(), seen)
                break
    return seen


def without_precompiled_header(command: str) -> list[str]:
    """The compile command for clang, which cannot read GCC's precompiled header."""
    words = shlex.split(command)
    kept = []
    skip = False
    for word, following in zip(words, [*words[1:], ""], strict=True):
        if skip:
            skip = False
        elif word == "-include" and following.endswith("cmake_pch.hxx"):
            kept += ["-include", "torch/torch.h"]
            skip = True
        elif word != "-Winvalid-pch":
            kept.append(word)
    return kept


def main(compile_commands: Path) -> int:
    version = subprocess.run(["clang-tidy", "--version"], check=True, capture_output=True).stdout
    checks = (ROOT / ".clang-tidy").read_bytes()
    entries = []
    for entry in json.loads(compile_commands.read_text()):
        source = Path(entry["file"]).resolve()
        if source.is_relative_to(ROOT / "cpp" / "ajna") or source.is_relative_to(ROOT / "cpp" / "apps"):
            entries.append((source, without_precompiled_header(entry["command"]), entry["directory"]))

    CACHE.mkdir(parents=True, exist_ok=True)
    torch_version = next((w for e in entries for w in e[1] if w.endswith("/site-packages/torch/include")), "")
    if torch_version:
        torch_version = (Path(torch_version).parent / "version.py").read_text()

    def key(source: Path, command: list[str]) -> str:
        digest = hashlib.sha256(version + checks + torch_version.encode())
        for path, content in sorted(our_files(source, {}).items()):
            digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + content)
        flags = [w for w in command if w.startswith(("-D", "-std", "-f"))]
        return (
            digest.hexdigest() if not flags else hashlib.sha256((digest.hexdigest() + repr(flags)).encode()).hexdigest()
        )

    todo = [(source, command, folder, CACHE / key(source, command)) for source, command, folder in entries]
    todo = [item for item in todo if not item[3].exists()]
    print(f"clang-tidy: {len(entries)} files, {len(entries) - len(todo)} unchanged since they last passed", flush=True)

    with tempfile.TemporaryDirectory() as database:
        rows = [{"file": str(s), "arguments": c, "directory": d} for s, c, d, _ in todo]
        (Path(database) / "compile_commands.json").write_text(json.dumps(rows))

        def check(item: tuple[Path, list[str], str, Path]) -> bool:
            source, _, _, passed = item
            start = time.monotonic()
            result = subprocess.run(
                ["clang-tidy", "--quiet", "-p", database, "--extra-arg=-Wno-unknown-warning-option", str(source)],
                capture_output=True,
                text=True,
            )
            print(f"  {source.relative_to(ROOT)} ({time.monotonic() - start:.0f} s)", flush=True)
            if result.returncode == 0:
                passed.touch()
            else:
                print(result.stdout + result.stderr, flush=True)
            return result.returncode == 0

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            results = list(pool.map(check, todo))
    return 0 if all(results) else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
