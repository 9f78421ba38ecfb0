"""The command line in forks of one process that has imported everything: a start takes 0.3 seconds instead of 3.

A fork is a process group of its own, gets its signals and ends as `python -m fd_mitsuba` does; only the imports are
behind it. What is about the imports takes `tiny_runs.start_words`.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NoReturn

SOURCE = Path(__file__).resolve().parents[2] / "src"


class WarmRun:
    """A run that was started; of `subprocess.Popen` what tests need of it."""

    def __init__(self, words: list[str], environment: dict[str, str]) -> None:
        self._texts = [tempfile.NamedTemporaryFile(prefix="warm_run_") for _ in range(2)]
        files = [file.name for file in self._texts]
        self.pid = int(_asked({"words": words, "environment": environment, "files": files}))
        self.returncode: int | None = None
        self._said: tuple[str, str] | None = None

    def poll(self) -> int | None:
        """The exit code, the negative number of the signal that ended it, or None while it runs."""
        if self.returncode is None:
            self.returncode = _asked({"pid": self.pid})
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send it, unless the run has ended; until it is asked for, nothing else can have its number."""
        if self.returncode is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Wait for its end; what it wrote to stdout and stderr. Raises subprocess.TimeoutExpired."""
        latest = time.monotonic() + (600 if timeout is None else timeout)
        while self.poll() is None:
            if time.monotonic() > latest:
                raise subprocess.TimeoutExpired("fd_mitsuba", timeout or 600)
            time.sleep(0.01)
        if self._said is None:
            output, errors = (Path(file.name).read_text() for file in self._texts)
            self._said = output, errors
            for file in self._texts:
                file.close()
        return self._said


def start_warm(words: list[str], **environment: str) -> WarmRun:
    """As `tiny_runs.start_words`, without the imports."""
    return WarmRun(words, environment)


@cache
def _server() -> subprocess.Popen[str]:
    server = subprocess.Popen(
        [sys.executable, __file__],
        env=os.environ | {"PYTHONPATH": str(SOURCE), "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"},
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    atexit.register(_stop, server)
    return server


def _stop(server: subprocess.Popen[str]) -> None:
    assert server.stdin is not None and server.stdout is not None
    server.stdin.close()
    server.wait(timeout=60)
    server.stdout.close()


def _asked(request: dict) -> int | None:
    server = _server()
    assert server.stdin is not None and server.stdout is not None
    server.stdin.write(json.dumps(request) + "\n")
    server.stdin.flush()
    return json.loads(server.stdout.readline())


def _serve() -> None:
    """Fork and look after forks, as asked on stdin."""
    from fd_mitsuba.backend.startup import choose_llvm

    choose_llvm()
    # Whatever a run imports; nothing here may start a thread.
    import diffusers
    import drjit  # noqa: F401
    import mitsuba  # noqa: F401
    import transformers

    import fd_mitsuba.cli.main
    import fd_mitsuba.evaluation.report.run_page  # noqa: F401
    import fd_mitsuba.runs.pipeline  # noqa: F401

    assert diffusers.UNet2DConditionModel and diffusers.AutoencoderKL and transformers.CLIPTextModel
    for line in sys.stdin:
        request = json.loads(line)
        if "pid" in request:
            ended, status = os.waitpid(request["pid"], os.WNOHANG)
            answer = os.waitstatus_to_exitcode(status) if ended else None
        else:
            answer = os.fork()
            if answer == 0:
                _become(request, fd_mitsuba.cli.main.main)
        print(json.dumps(answer), flush=True)


def _become(request: dict, main: Callable[[], int]) -> NoReturn:
    """Turn this fork into the command line. What Dr.Jit does as Python ends is for threads that it does not have."""
    os.setsid()
    os.environ.update(request["environment"])
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, path in enumerate(request["files"], 1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_APPEND), number)
    sys.argv = ["fd_mitsuba", *request["words"]]
    code: object = 1
    try:
        code = main()
    except SystemExit as stop:
        code = stop.code
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code if isinstance(code, int) else 1)


if __name__ == "__main__":
    _serve()
