# SPDX-License-Identifier: MIT
"""The layering of docs/architecture.md: who includes whom, headers that stand alone, licence lines, file sizes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sysconfig
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch.utils.cpp_extension

ROOT = Path(__file__).resolve().parents[2]
CPP = ROOT / "cpp"
MAX_LINES = 400

TORCH = ("torch/", "ATen/", "c10/")
OPENCV = ("opencv2/",)
EIGEN = ("Eigen/",)
#: library -> (libraries of ours, libraries that only its sources may include, prefixes of third-party headers)
TABLE: dict[str, tuple[set[str], set[str], tuple[str, ...]]] = {
    "base": (set(), set(), ()),
    "geometry": ({"base"}, set(), EIGEN),
    "control": ({"base"}, set(), EIGEN),
    "nn": ({"base"}, set(), TORCH),
    "loss": ({"base"}, set(), TORCH),
    "synth": ({"base"}, set(), TORCH),
    "engine": ({"base"}, {"nn"}, TORCH),
    "io": ({"base"}, set(), OPENCV),
    "tasks": ({"base", "geometry"}, set(), OPENCV + EIGEN),
    "skills": ({"base", "geometry", "tasks", "control"}, set(), OPENCV + EIGEN),
    "flight": ({"base", "geometry", "io", "engine", "tasks", "control", "skills"}, set(), (*EIGEN, "mavlink/")),
}
POSIX = {"dirent.h", "fcntl.h", "sys/stat.h", "sys/types.h", "unistd.h"}
POSIX |= {"malloc.h"}  # of glibc, where it is there
POSIX |= {"netdb.h", "netinet/in.h", "netinet/tcp.h", "poll.h", "sched.h", "sys/inotify.h", "sys/socket.h", "termios.h"}

SOURCES = sorted([*CPP.rglob("*.hpp"), *CPP.rglob("*.cpp")])
HEADERS = [path for path in SOURCES if path.suffix == ".hpp" and path.is_relative_to(CPP / "ajna")]
INCLUDE = re.compile(r'^\s*#\s*include\s*([<"])([^>"]+)[>"]', re.MULTILINE)


def includes(path: Path) -> list[tuple[str, str]]:
    """(bracket, name) of each include of a file."""
    return INCLUDE.findall(path.read_text())


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def is_private(header: Path) -> bool:
    """A header of the engine that its users do not see: included by no other library."""
    return header.parent.name == "engine" and header.name != "flow_engine.hpp"


@pytest.mark.parametrize(
    "path", [p for p in SOURCES if p.is_relative_to(CPP / "ajna")], ids=lambda p: str(p.relative_to(CPP / "ajna"))
)
def test_includes_follow_the_table(path: Path) -> None:
    library = path.relative_to(CPP / "ajna").parts[0]
    assert library in TABLE, f"{library} is not in the table of docs/architecture.md"
    ours, in_sources, third_party = TABLE[library]
    if path.suffix == ".cpp" or is_private(path):
        ours = ours | in_sources
    elif library == "engine":
        third_party = ()  # LibTorch is private to the engine
    for bracket, name in includes(path):
        if bracket == '"':
            match = re.fullmatch(r"ajna/(\w+)/[\w./]+\.hpp", name)
            assert match, f'{name_of(path)}: #include "{name}" is not a path from cpp/, like "ajna/base/error.hpp"'
            assert match[1] in {*ours, library}, f"{name_of(path)} may not include {name}"
        else:
            standard = re.fullmatch(r"[a-z_0-9]+", name) or name in POSIX
            assert standard or name.startswith(third_party or ("\0",)), f"{name_of(path)} may not include <{name}>"


def test_the_table_is_the_documented_one() -> None:
    documented = re.findall(r"^\| ([a-z, ]+) \| ", (ROOT / "docs/architecture.md").read_text(), re.MULTILINE)
    names = {name for row in documented for name in row.split(", ")}
    assert set(TABLE) <= names


def test_every_source_is_built() -> None:
    """A source that no CMakeLists.txt names would be dead code."""
    for path in SOURCES:
        if path.suffix == ".cpp":
            listing = path.parent / "CMakeLists.txt"
            known = re.search(rf"\b{re.escape(path.stem)}\b", listing.read_text()) or path.parent.name == "bench"
            assert known, f"{name_of(path)} is in no target of {name_of(listing)}"


def tracked(*suffixes: str) -> list[Path]:
    folders = ("cpp", "python", "tests", "tools", "train")
    found = [p for folder in folders for p in (ROOT / folder).rglob("*") if p.suffix in suffixes and p.is_file()]
    return sorted(p for p in found if "__pycache__" not in p.parts)


def test_licence_line_comes_first() -> None:
    missing = []
    for path in tracked(".cpp", ".hpp", ".py", ".pyi", ".sh"):
        if "SPDX-License-Identifier: MIT" not in "\n".join(path.read_text().split("\n")[:2]):
            missing.append(name_of(path))
    assert missing == []


def test_files_stay_readable() -> None:
    """No file over 400 lines; what comes near is listed as a warning."""
    lengths = {name_of(p): len(p.read_text().splitlines()) for p in tracked(".cpp", ".hpp", ".py", ".cmake", ".sh")}
    near = {name: n for name, n in lengths.items() if MAX_LINES * 0.9 < n <= MAX_LINES}
    if near:
        warnings.warn(f"files near {MAX_LINES} lines: {near}", stacklevel=1)
    assert {name: n for name, n in lengths.items() if n > MAX_LINES} == {}


# --- headers that stand alone ---


def torch_closure(header: Path, seen: set[Path] | None = None) -> bool:
    """Whether a header brings LibTorch's in, itself or through headers of ours."""
    seen = set() if seen is None else seen
    seen.add(header)
    for bracket, name in includes(header):
        if bracket == "<" and name.startswith(TORCH):
            return True
        inner = CPP / name
        if bracket == '"' and inner.is_file() and inner not in seen and torch_closure(inner, seen):
            return True
    return False


@pytest.fixture(scope="session")
def compiler(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A C++17 compiler that only checks syntax (all headers must hold to the oldest supported standard)."""
    command = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++")
    if command is None:
        pytest.skip("no C++ compiler")
    flags = ["-std=c++17", "-fPIC", "-w", f"-I{CPP}", f"-I{sysconfig.get_path('include')}"]
    flags += [f"-isystem{path}" for path in torch.utils.cpp_extension.include_paths()]
    flags += ["-isystem/usr/include/opencv4", "-isystem/usr/include/eigen3"]
    return [*command.split(), *flags]


def check(headers: list[Path], compiler: list[str], folder: Path, prefix: list[str]) -> None:
    """Compile a source per header that includes only this header (after `prefix`)."""

    def one(header: Path) -> str:
        source = folder / (str(header.relative_to(CPP)).replace("/", "_") + ".cpp")
        source.write_text(f'#include "{header.relative_to(CPP)}"\n#include "{header.relative_to(CPP)}"\n')
        command = [*compiler, *prefix, "-fsyntax-only", source]
        result = subprocess.run(command, capture_output=True, text=True)
        return "" if result.returncode == 0 else f"{name_of(header)} does not compile alone:\n{result.stderr[:3000]}"

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        errors = [error for error in pool.map(one, headers) if error]
    assert not errors, "\n".join(errors)


def test_headers_without_torch_compile_alone(compiler: list[str], tmp_path: Path) -> None:
    check([header for header in HEADERS if not torch_closure(header)], compiler, tmp_path, [])


@pytest.mark.slow
def test_headers_with_torch_compile_alone(compiler: list[str], tmp_path: Path) -> None:
    """LibTorch is parsed once: a header that includes it (torch_closure read so) would parse the same text again."""
    (tmp_path / "pch.hpp").write_text("#include <torch/torch.h>\n")
    command = [*compiler, "-x", "c++-header", tmp_path / "pch.hpp", "-o", tmp_path / "pch.hpp.gch"]
    subprocess.run(command, check=True)
    headers = [header for header in HEADERS if torch_closure(header)]
    assert headers
    check(headers, compiler, tmp_path, ["-include", str(tmp_path / "pch.hpp")])
    (tmp_path / "pch.hpp.gch").unlink()  # 700 MB: not for pytest's kept folders
