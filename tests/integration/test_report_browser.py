"""Reports and galleries in a browser, from file://. Slow, and skipped where there is none.

The browser needs chromium and `npm install` in tools/viewers.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from report_setup import make_run
from test_export_assets import Learned, exported, textured_base  # noqa: F401
from viewer_setup import VIEWERS, needs_browser

from fd_mitsuba.evaluation.report.gallery import write_gallery
from fd_mitsuba.evaluation.report.run_page import write_report
from fd_mitsuba.scene.load_scene import load_edit_scene

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900), needs_browser]


def opened(page: Path, picture: Path, width: int, scheme: str) -> dict:
    """What the page did in the browser; it said nothing to the console, asked for nothing, and is not too wide."""
    command = ["node", str(VIEWERS / "screenshot_page.mjs"), str(page), str(picture), str(width), scheme]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    assert found["problems"] == [] and found["requests"] == [] and found["overflow"] <= 0, found
    return found


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_report(width: int, scheme: str, make_scene, textured_base: str, tmp_path: Path) -> None:  # noqa: F811
    run = make_run(tmp_path / "run")
    exported(load_edit_scene(make_scene(base=textured_base)), run / "export", Learned, size=64)
    found = opened(write_report(run), tmp_path / "page.png", width, scheme)
    assert found["materials"] == ["ball", "part_part"]
    assert found["turned"] and found["cut"] == "50%" and found["shown"] == 1  # one pair of three
    pixels = np.asarray(Image.open(tmp_path / "page.png").convert("L")).astype(float)
    assert pixels.std() > 10 and (np.median(pixels) > 128) == (scheme == "light")


def test_gallery(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / "b"), make_run(tmp_path / "a", ("geometry",), finished=False)]
    found = opened(write_gallery(runs, tmp_path / "all.html"), tmp_path / "page.png", 1280, "light")
    assert found["sorted"][0] == "a"
