"""The lock on a run folder: one process at a time, freed by any end of it, nothing left behind."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.run_lock import LOCK_NAME, run_lock

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import sys
from pathlib import Path
from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.run_lock import run_lock
print("ready", flush=True)
sys.stdin.readline()
try:
    with run_lock(Path(sys.argv[1])):
        print("in", flush=True)
        sys.stdin.readline()
except UserError as error:
    print(error, flush=True)
"""


def start(folder: Path) -> subprocess.Popen[str]:
    """A process that waits for a line, tries to lock the folder, says how that went, and waits for another line."""
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", SCRIPT, str(folder)], env=environment, text=True, **pipes)


def heard(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def tell(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def test_the_second_hears_who_has_it_and_a_kill_frees_it(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "out"
    for _ in range(3):
        process = start(folder)
        try:
            tell(process)
            assert [heard(process), heard(process)] == ["ready", "in"]
            with pytest.raises(UserError, match=rf"out: is used by process {process.pid} on .* since \d{{4}}-"):
                run_lock(folder).__enter__()
        finally:
            process.send_signal(signal.SIGKILL)
            process.communicate()
        assert (folder / LOCK_NAME).exists()  # left behind, and of no account
        with run_lock(folder):
            assert json.loads((folder / LOCK_NAME).read_text())["process"] == os.getpid()
        assert not (folder / LOCK_NAME).exists()


def test_one_of_many_gets_it_in_20_of_20_tries(tmp_path: Path) -> None:
    for number in range(20):
        processes = [start(tmp_path / f"out{number}") for _ in range(3)]
        assert [heard(process) for process in processes] == ["ready"] * 3
        for process in processes:
            tell(process)
        said = [heard(process) for process in processes]
        assert said.count("in") == 1, said
        holder = processes[said.index("in")]
        assert sum(f"is used by process {holder.pid} " in line for line in said) == 2, said
        tell(holder)
        for process in processes:
            process.communicate(timeout=60)


HASTY = """
import os, sys, time
from pathlib import Path
from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.run_lock import run_lock
folder, end, entered = Path(sys.argv[1]), time.time() + 3, 0
mark = folder.with_name(f"mark.{os.getpid()}")
while time.time() < end:
    try:
        with run_lock(folder):
            mark.touch()
            assert len(list(folder.parent.glob("mark.*"))) == 1, "two are inside"
            mark.unlink()
            entered += 1
    except UserError:
        pass
assert entered > 5, entered
"""


def test_nobody_holds_the_lock_of_a_file_that_is_gone(tmp_path: Path) -> None:
    """Three that come and go, each removing the folder when it leaves: never two of them are inside."""
    command = [sys.executable, "-c", HASTY, str(tmp_path / "out")]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    processes = [subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    for process in processes:
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
    assert not any((tmp_path / "out").glob("*"))


def test_the_same_thread_may_take_it_again_but_no_other(tmp_path: Path) -> None:
    refused = []

    def other() -> None:
        try:
            with run_lock(tmp_path / "out"):
                pass
        except UserError as error:
            refused.append(str(error))

    with run_lock(tmp_path / "out"):
        with run_lock(tmp_path / "." / "out"):
            pass
        assert (tmp_path / "out" / LOCK_NAME).exists()
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert len(refused) == 1 and "another run of this process" in refused[0]


def test_what_was_there_stays(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("precious")
    for name in ("empty", "full"):
        with run_lock(tmp_path / name):
            pass
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["empty", "full", "thesis.tex"]


def test_a_file_system_without_locks_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unsupported(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    said: list[str] = []
    monkeypatch.setattr(fcntl, "flock", unsupported)
    with run_lock(tmp_path / "out", said.append):
        pass
    assert len(said) == 1 and "has no locks" in said[0]
