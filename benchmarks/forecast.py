"""What `check` announces against what a run takes: `python benchmarks/forecast.py [--json] [--only NAME ...]`.

The cat with `configs/quick.toml`, as it is and with one input that is far larger, and three steps with a network as
wide as Stable Diffusion 1.5's. Each run is a process of its own.

    announced_mb, peak_mb  most memory: as announced, and the largest resident set of the run's process
    announced_s, seconds   wall time of the whole command, likewise; says something only on a machine with nothing else
                           to do
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

import numpy as np  # noqa: E402
import trimesh  # noqa: E402
from machine import machine  # noqa: E402
from PIL import Image  # noqa: E402
from wide_network import save_wide_network  # noqa: E402

SCENE = ROOT / "scenes" / "cat" / "scene.xml"


def as_shipped(folder: Path) -> list[str]:
    """The demo."""
    return [str(SCENE)]


def many_faces(folder: Path) -> list[str]:
    """Its base with each edge cut twice in two, and a ball beside it: 1.6 million faces."""
    source = trimesh.load(SCENE.with_name("cat.ply"), process=False)
    assert isinstance(source, trimesh.Trimesh)
    fine = trimesh.util.concatenate([source.subdivide().subdivide(), _ball()])
    fine.export(folder / "cat.ply", include_attributes=False)
    text = _text()
    start, end = text.index('<texture type="bitmap" name="base_color">'), text.index('<float name="specular"')
    (folder / "scene.xml").write_text(text[:start] + '<rgb name="base_color" value="0.5"/>' + text[end:])
    return [str(folder / "scene.xml")]


def many_faces_around(folder: Path) -> list[str]:
    """The same ball as surroundings: 1.3 million faces that are lit and not edited."""
    for name in ("cat.ply", "cat_base_color.png", "cat_roughness.png"):
        (folder / name).write_bytes(SCENE.with_name(name).read_bytes())
    _ball().export(folder / "ball.ply")
    choice = '<string name="base" value="base"/>'
    ball = '<shape type="ply" id="ball"><string name="filename" value="ball.ply"/></shape>'
    text = _text().replace("</integrator>", f"{choice}</integrator>").replace("</scene>", f"{ball}</scene>")
    (folder / "scene.xml").write_text(text)
    return [str(folder / "scene.xml")]


def large_light(folder: Path) -> list[str]:
    """An environment of 8192 x 4096 pixels."""
    from fd_mitsuba.backend.startup import start

    mi = start()
    rows = np.linspace(0.2, 1.0, 4096, dtype=np.float32)[:, None, None]
    pixels = np.broadcast_to(rows, (4096, 8192, 3))
    mi.Bitmap(np.ascontiguousarray(pixels)).write(str(folder / "light.exr"))
    return [str(SCENE), "-D", f"light={folder / 'light.exr'}"]


def large_textures(folder: Path) -> list[str]:
    """The base's textures at 4096 x 4096."""
    for name in ("cat_base_color.png", "cat_roughness.png"):
        with Image.open(SCENE.with_name(name)) as picture:
            picture.resize((4096, 4096)).save(folder / name, compress_level=1)
    (folder / "cat.ply").write_bytes(SCENE.with_name("cat.ply").read_bytes())
    (folder / "scene.xml").write_text(_text())
    return [str(folder / "scene.xml")]


def large_bake(folder: Path) -> list[str]:
    """Baked textures of 4096 x 4096."""
    return [str(SCENE), "--set", "output.texture_size=4096"]


def fine_grid(folder: Path) -> list[str]:
    """A grid of 128 cells a side."""
    return [str(SCENE), "--set", "geometry.grid_resolution=128"]


def wide_network(folder: Path) -> list[str]:
    """Random weights of Stable Diffusion 1.5's widths, one view at a time: a step of each phase and one of material."""
    model = save_wide_network(folder / "model")
    steps = ("geometry.steps=2", "geometry.coarse_fraction=0.5", "geometry.views=1")
    steps += ("appearance.steps=1", "appearance.views=1", "guidance.views_per_call=1", f"guidance.model={model}")
    return [str(SCENE), "-c", "paper", *(word for step in steps for word in ("--set", step))]


def _text() -> str:
    """The scene file, to be put in another folder."""
    return SCENE.read_text().replace("../lighting", str(SCENE.parent.parent / "lighting"))


def _ball() -> trimesh.Trimesh:
    """Of 1.3 million faces, beside the cat."""
    ball = trimesh.creation.icosphere(subdivisions=8, radius=3.5)
    ball.apply_translation([-0.5, 3.5, 40.0])
    return ball


CASES: dict[str, Callable[[Path], list[str]]] = {
    make.__name__: make
    for make in (
        as_shipped,
        many_faces,
        many_faces_around,
        large_light,
        large_textures,
        large_bake,
        fine_grid,
        wide_network,
    )
}


def measured(make: Callable[[Path], list[str]], threads: int) -> dict[str, Any]:
    """One case, forecast and run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = ["-c", "quick", "-t", str(threads), *make(folder)]  # of two settings the last counts
        python = [sys.executable, "-m", "fd_mitsuba"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
        check = subprocess.run([*python, "check", *words, "--json"], capture_output=True, text=True, env=environment)
        if check.returncode:
            raise SystemExit(check.stderr)
        cost = json.loads(check.stdout)["cost"]
        started = time.monotonic()
        with (folder / "log").open("w") as log:
            run = [*python, "run", *words, "-o", str(folder / "run")]
            process = subprocess.Popen(run, stdout=log, stderr=log, env=environment)
            _, status, used = os.wait4(process.pid, 0)
        seconds = time.monotonic() - started
        if status:
            raise SystemExit((folder / "log").read_text())
        return {
            "announced_mb": round(cost["memory_mb"]),
            "peak_mb": round(used.ru_maxrss / 1024),
            "announced_s": round(cost["seconds_total"] + cost["appearance_seconds_total"]),
            "seconds": round(seconds),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("-t", "--threads", type=int, default=0)
    options = parser.parse_args()
    rows = {}
    for name in options.only:
        rows[name] = measured(CASES[name], options.threads)
        if not options.json:
            print(f"{name:16}", "  ".join(f"{key} {value:>6}" for key, value in rows[name].items()), flush=True)
    if options.json:
        from fd_mitsuba.backend.threads import share_cores

        share_cores(options.threads)
        print(json.dumps({**rows, "machine": machine()}, indent=2))


if __name__ == "__main__":
    main()
