"""Runs of seconds: a folder with a scene and tiny settings, and the command line in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from conftest import BASE, INTEGRATOR, LIGHT, PART, REGION, write_ply

ROOT = Path(__file__).resolve().parents[2]
FIELD = """
[field]
levels = 2
log2_table = 8
base_resolution = 4
finest_resolution = 16
"""
TEXTURE = """
[texture]
levels = 2
log2_table = 8
"""
BOTH_STAGES_OUTPUT = """
[output]
sheet_every = 2
checkpoint_every = 2
turntable_frames = 2
turntable_size = 32
picture_size = 32
texture_size = 32
faces = 1000
"""
ORANGE_PART = PART.replace("<float", '<rgb name="base_color" value="0.8, 0.3, 0.1"/><float')


def write_place(
    root: Path,
    animal: tuple[np.ndarray, np.ndarray],
    settings: str,
    light: str = LIGHT,
    part: str = PART,
    region: str = REGION,
) -> Path:
    """`scene.xml` with the animal as its base, and `tiny.toml`, below `root`; returns it."""
    write_ply(root / "animal.ply", *animal)
    pieces = ['<scene version="3.0.0">', light, INTEGRATOR, BASE, part, region, "</scene>"]
    (root / "scene.xml").write_text("\n".join(pieces))
    (root / "tiny.toml").write_text(settings)
    return root


def run_words(place: Path, output: str, *more: str, scene: Path | None = None) -> list[str]:
    """The command line's words for a run of the place's scene with one thread into its folder `output`.

    Args:
        place: of `write_place`.
        output: below it, or absolute.
        scene: another one, with the settings of the place.
    """
    files = ["run", scene or place / "scene.xml", "-c", place / "tiny.toml", "-o", place / output]
    return [str(word) for word in (*files, "-t", "1", "-q", *more)]


def start_words(words: list[str], **environment: str) -> subprocess.Popen[str]:
    """The command line in a process group of its own: what the test run's terminal sends does not reach it."""
    return subprocess.Popen(
        [sys.executable, "-m", "fd_mitsuba", *words],
        env=os.environ | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"} | environment,
        text=True,
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
