"""Runs of the command line in children of one warm process, with limits of time and memory: nothing can take the tests
with it.

The warm process has imported everything and started nothing: no thread runs in it, so that forking it is safe, and a
child has only Mitsuba's own start (0.2 s) to wait for instead of three seconds of imports.
"""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

_PATIENCE = 5
SOURCE = Path(__file__).resolve().parents[2] / "src"

WORKS, REFUSED, USAGE = "works", "one line, exit 1", "usage, exit 2"
TRACEBACK, SIGNAL, HANG, OTHER = "traceback", "signal", "hang", "other"
_PLACE = re.compile(
    r"\.\w+:\d+|<\w+|(^| )--?\w|line \d+|\w+\.\w+ ?=|base \w+|placement \d+: |"
    r"\.toml: (\w+(\.\w+)*: |unknown key|not valid)"
)
_WHOLE_FILE = re.compile(
    r": (the file is empty|(is a|is not a|is no|no such|not a|not an|cannot be read|not found|has|is larger than)\b)"
)
_ASSET = re.compile(r"\.(3ds|dae|glb|gltf|obj|off|ply|stl|zip): [^;]+; \w")
"""Files without lines: what is wrong and what to do, after the file's name."""
_LIBRARIES = ("Corrupt JPEG data", "Premature end of JPEG file", "Warning: unknown JFIF")
"""Lines that a decoder writes to stderr itself."""
ALLOWED = (WORKS, REFUSED, USAGE)


@dataclass(frozen=True)
class Outcome:
    """How one run of the command line ended."""

    arguments: tuple[str, ...]
    code: int
    """Exit code; the negative number of the signal that ended it."""
    hung: bool
    seconds: float
    cpu_seconds: float
    megabytes: float
    """Peak of the resident memory."""
    output: str
    errors: str

    @property
    def kind(self) -> str:
        """One of the kinds above."""
        if self.hung:
            return HANG
        if self.code < 0:
            return SIGNAL
        if "Traceback (most recent call last)" in self.errors:
            return TRACEBACK
        if self.code == 0:
            return WORKS
        if self.code == 2:
            return USAGE
        said = [line for line in self.errors.splitlines() if line]
        told = bool(said) and said[-1].startswith("fd_mitsuba: error: ")
        ours = all(line.startswith(("fd_mitsuba: ", *_LIBRARIES)) for line in said)
        return REFUSED if self.code == 1 and told and ours else OTHER

    @property
    def message(self) -> str:
        """The line of a refusal without its lead, "" where there is none."""
        lines = [line for line in self.errors.splitlines() if line]
        return lines[-1].removeprefix("fd_mitsuba: error: ") if lines else ""

    @property
    def is_precise(self) -> bool:
        """Whether a refusal names an option, a setting, or a file and what in it, if not the file as a whole."""
        return self.kind == USAGE or any(pattern.search(self.message) for pattern in (_PLACE, _WHOLE_FILE, _ASSET))


class Forked:
    """The warm process; a context manager.

    Args:
        seconds: of CPU after which a run counts as hung and is ended, or a multiple of them that passed while it waited
            for something: on a busy machine a sound run may have to wait, too.
        megabytes: address space of a run.
    """

    def __init__(self, seconds: float = 30, megabytes: int = 6000) -> None:
        self.seconds, self.megabytes = seconds, megabytes

    def __enter__(self) -> Forked:
        paths = [str(SOURCE), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "PYTHONWARNINGS": "ignore"}
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
        )  # fmt: skip
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(timeout=60)
        self._process.stdout.close()

    def run(self, *arguments: str | Path, seconds: float | None = None) -> Outcome:
        """The outcome of `fd_mitsuba` with these arguments."""
        plain = [os.fsdecode(argument) for argument in arguments]
        request = {"arguments": plain, "seconds": seconds or self.seconds, "megabytes": self.megabytes}
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        return Outcome(tuple(plain), **answer)


def _serve() -> None:
    from fd_mitsuba.backend.startup import choose_llvm

    choose_llvm()
    # Whatever a command imports; nothing here may start a thread.
    import drjit  # noqa: F401
    import mitsuba  # noqa: F401

    import fd_mitsuba.assets.importing  # noqa: F401
    import fd_mitsuba.backend.threads  # noqa: F401
    import fd_mitsuba.cli.main  # noqa: F401
    import fd_mitsuba.evaluation.report.run_page  # noqa: F401
    import fd_mitsuba.runs.check  # noqa: F401
    import fd_mitsuba.runs.pipeline  # noqa: F401
    import fd_mitsuba.scene.edit_scene  # noqa: F401

    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        answers.write(json.dumps(_run(json.loads(line))) + "\n")
        answers.flush()


def _run(request: dict) -> dict:
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        start = time.monotonic()
        child = os.fork()
        if child == 0:
            _become(request, output.fileno(), errors.fileno())
        killed = False
        while not os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            waited = time.monotonic() - start
            if waited > request["seconds"] and (
                _cpu_seconds(child) > request["seconds"] or waited > _PATIENCE * request["seconds"]
            ):
                killed = True
                os.kill(child, 9)
            time.sleep(0.005 if waited < 5 else 0.2)
        _, status, usage = os.wait4(child, 0)
        texts = []
        for file in (output, errors):
            file.seek(0)
            texts.append(file.read(1 << 20).decode(errors="backslashreplace"))
    return {
        "code": os.waitstatus_to_exitcode(status),
        "hung": killed and os.waitstatus_to_exitcode(status) == -9,
        "seconds": time.monotonic() - start,
        "cpu_seconds": usage.ru_utime + usage.ru_stime,
        "megabytes": usage.ru_maxrss / 1024,
        "output": texts[0],
        "errors": texts[1],
    }


def _cpu_seconds(process: int) -> float:
    """What a process that runs or has just ended has spent."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _become(request: dict, output: int, errors: int) -> None:
    """Turn this child into `fd_mitsuba`; does not return."""
    code = 99
    try:
        resource.setrlimit(resource.RLIMIT_AS, (request["megabytes"] << 20,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(output, 1)
        os.dup2(errors, 2)
        sys.argv = ["fd_mitsuba", *request["arguments"]]
        from fd_mitsuba.cli.main import main

        code = main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 1
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


if __name__ == "__main__":
    _serve()
