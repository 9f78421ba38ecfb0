"""`fd_mitsuba doctor`: what it finds here, and that a missing piece is a line of the report, not a crash."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fd_mitsuba.errors import UserError
from fd_mitsuba.runs import doctor

ROOT = Path(__file__).resolve().parents[2]
NAMES = ["python", "cores", "llvm", "mitsuba", "rendering on a card", "torch", "diffusers", "built-in prior", "memory"]


def run_doctor(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fd_mitsuba", "doctor", *words],
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")} | environment,
        capture_output=True,
        text=True,
        timeout=100,
    )


def test_json_on_this_machine() -> None:
    done = run_doctor("--json")
    report = json.loads(done.stdout)
    assert list(report) == NAMES and done.stderr == ""
    assert all(set(entry) == {"ok", "found"} and "\n" not in entry["found"] for entry in report.values())
    for name in ("python", "cores", "llvm", "mitsuba", "torch", "diffusers", "memory"):
        assert report[name]["ok"], report[name]
    assert "LLVM" in report["llvm"]["found"] and "a test kernel ran" in report["mitsuba"]["found"]
    card = report["rendering on a card"]
    assert card["ok"] and ("cuda_ad_rgb" in card["found"] or "finds no NVIDIA card" in card["found"])
    assert "cuda" in report["torch"]["found"]
    assert done.returncode == (0 if report["built-in prior"]["ok"] else 1)


def test_bad_llvm_is_a_line(tmp_path: Path) -> None:
    done = run_doctor(DRJIT_LIBLLVM_PATH=str(tmp_path / "libLLVM.so"))
    assert done.returncode == 1 and done.stderr == ""
    bad = [line for line in done.stdout.splitlines() if line.startswith("BAD")]
    assert [line.split(":")[0] for line in bad][:2] == ["BAD llvm", "BAD mitsuba"]
    assert all("no such file" in line and "unset it" in line for line in bad[:2])
    assert len(done.stdout.splitlines()) == len(NAMES)


@pytest.mark.parametrize(
    "error", [UserError("a; b"), ImportError("no module"), OSError(5, "libtorch"), RuntimeError("JIT\nsaid\nmuch")]
)
def test_whatever_fails_becomes_one_line(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail() -> str:
        raise error

    monkeypatch.setattr(doctor, "_torch", fail)
    findings = {finding.name: finding for finding in doctor.examine()}
    assert not findings["torch"].ok and "\n" not in findings["torch"].text and findings["torch"].text
    assert findings["mitsuba"].ok


def test_a_reader_that_has_gone_is_no_error_of_ours() -> None:
    words = [sys.executable, "-m", "fd_mitsuba", "names"]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    reading, writing = os.pipe()
    process = subprocess.Popen(words, env=environment, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    os.close(reading)
    assert process.communicate(timeout=100) == (None, "") and process.returncode == 1
