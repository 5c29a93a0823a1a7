# SPDX-License-Identifier: MIT
"""The main job on real frames: `ajna predict` and `ajna video` on the pictures of Debian's package opencv-doc.

demo.py [OUT]: the frames come from an installed opencv-doc, else from the package itself, downloaded and unpacked
beside the build without installing it (container images leave /usr/share/doc out); where neither can be had, from our
own scene generator. Pictures go to OUT (demo-out).
"""

from __future__ import annotations

import gzip
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

FRAMES = ("basketball1.png", "basketball2.png", "aloeL.jpg", "aloeR.jpg", "vtest.avi")
UNPACKED = Path("build/opencv-doc")
BIN = Path(sys.executable).parent


def candidates() -> Iterator[Path]:
    """Folders that may hold the frames, the cheapest first."""
    yield Path("/usr/share/doc/opencv-doc/examples/data")
    try:
        listing = subprocess.run(["dpkg", "-L", "opencv-doc"], capture_output=True, text=True)
    except FileNotFoundError:
        return  # not a Debian
    yield from {Path(line).parent for line in listing.stdout.splitlines() if "basketball1.png" in line}
    if not UNPACKED.is_dir():
        download()
    yield from {path.parent for path in UNPACKED.rglob("basketball1.png*")}


def download() -> None:
    """Unpack the package opencv-doc in UNPACKED; leaves nothing where it cannot be had."""
    print("Fetching the frames: Debian package opencv-doc (92 MiB, once) ...", flush=True)
    parts = UNPACKED.with_suffix(".part")
    shutil.rmtree(parts, ignore_errors=True)
    parts.mkdir(parents=True)
    try:
        subprocess.run(["apt-get", "download", "-q", "opencv-doc"], cwd=parts, check=True)
        (package,) = parts.glob("opencv-doc_*.deb")
        subprocess.run(["dpkg-deb", "-x", package.name, "."], cwd=parts, check=True)
        package.unlink()
        parts.rename(UNPACKED)
    except (OSError, ValueError, subprocess.CalledProcessError) as error:
        print(f"opencv-doc cannot be had: {error}", file=sys.stderr)
        shutil.rmtree(parts, ignore_errors=True)


def collect(folder: Path) -> bool:
    """Put the real frames into `folder`, decompressed; False where they are nowhere to be found."""
    for source in candidates():
        found = {name: next(iter(source.glob(f"{name}*")), None) for name in FRAMES}
        if all(found.values()):
            folder.mkdir(parents=True, exist_ok=True)
            for name, path in found.items():
                assert path is not None
                with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as stream:
                    (folder / name).write_bytes(stream.read())
            return True
    return False


def render(folder: Path) -> None:
    """Two frames of a synthetic scene as folder/frame1.png, frame2.png."""
    from ajna import io
    from ajna.synth import PairGenerator

    pair = PairGenerator()(1, 240, 320, seed=1)
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("frame1", "frame2"):
        io.write_image(folder / f"{name}.png", getattr(pair, name)[0].permute(1, 2, 0).contiguous().numpy())


def ajna(*arguments: object) -> None:
    command = [str(argument) for argument in arguments]
    print("$ ajna", *command, flush=True)
    subprocess.run([BIN / "ajna", *command], check=True)


def main(out: Path) -> None:
    frames = out / "frames"
    if collect(frames):
        # A ball in flight; a plant seen by a stereo camera, four times reduced; a street with people.
        ajna("predict", frames / "basketball1.png", frames / "basketball2.png", "--out", out / "basketball")
        ajna("predict", frames / "aloeL.jpg", frames / "aloeR.jpg", "--size", "320x277", "--out", out / "aloe")
        ajna("video", frames / "vtest.avi", "--max-frames", 40, "--out", out / "street.mp4")
        kind = "real frames (Debian's opencv-doc)"
    else:
        print("No real frames here, so the demo renders a scene with Ajna's own generator instead.")
        render(frames)
        ajna("predict", frames / "frame1.png", frames / "frame2.png", "--out", out / "rendered")
        kind = "rendered frames"
    print(f"\nFlow and uncertainty of {kind}; look at:")
    for path in sorted([*out.glob("*/overview.png"), *out.glob("*.mp4")]):
        print(f"  {path}")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out"))
    except subprocess.CalledProcessError as error:
        sys.exit(f"demo: `{' '.join(map(str, error.cmd))}` failed with exit code {error.returncode}")
