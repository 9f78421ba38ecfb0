"""What the process gets from outside that no option says: streams, and names that are no text."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import fd_mitsuba as fd
from fd_mitsuba.cli.main import main

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes" / "cat" / "scene.xml"


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_change_nothing(closed: str) -> None:
    """As cron jobs and services may start a program."""
    script = f'exec "{sys.executable}" -m fd_mitsuba check scenes/cat/scene.xml {closed}'
    done = subprocess.run(["bash", "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert ("nothing to warn of" in done.stdout) == (" >&-" not in f" {closed}")


def test_names_that_are_no_text_are_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / os.fsdecode(b"k\xe4tze")
    folder.mkdir()
    scene = folder / "scene.xml"
    scene.write_bytes(SCENE.read_bytes())
    assert main(["check", str(scene)]) == 1
    message = capfd.readouterr().err
    assert message.count("\n") == 1 and "k\\udce4tze" in message and "is not UTF-8 text; write it so, rename" in message
    with pytest.raises(fd.UserError, match="reads no path that is not UTF-8 text; rename the folder"):
        fd.load_scene(scene)
