"""Runs of pytest in children of one warm process, with limits of time and memory, on a module of which a mutant takes
the place.

The warm process has imported the libraries, and nothing of fd_mitsuba; no thread runs in it, so that forking it is
safe. A child has half a second of imports left instead of three.
"""

from __future__ import annotations

import importlib
import os
import resource
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib.machinery import SourceFileLoader
from pathlib import Path

from mutants import MARK

ROOT = Path(__file__).resolve().parents[2]
PASSED, FAILED, TIME, NEVER = "passed", "failed", "time limit", "never loaded"
_LIBRARIES = (
    "torch", "mitsuba", "drjit", "numpy", "scipy.ndimage", "scipy.sparse.csgraph", "scipy.spatial", "trimesh", "igl",
    "manifold3d", "xatlas", "pygltflib", "PIL.Image", "pydantic.fields", "pydantic.main", "jinja2", "rich.progress",
    "imageio", "safetensors", "jaxtyping", "beartype", "hypothesis", "pytest", "skimage.measure",
    "fast_simplification", "diffusers.schedulers.scheduling_ddpm", "diffusers.schedulers.scheduling_ddim",
    "_hypothesis_pytestplugin", "pytest_timeout",
)  # fmt: skip
_MEGABYTES = 12_000


@dataclass(frozen=True)
class Outcome:
    """How one run of pytest ended.

    Attributes:
        kind: one of the kinds above.
        cpu_seconds: what it took.
        output: of pytest.
    """

    kind: str
    cpu_seconds: float
    output: str


def warm_up(folder: str) -> None:
    """Import everything that a child may need and that starts no thread; compiled files go to a folder."""
    os.environ["OMP_NUM_THREADS"] = "1"
    # A child compiles what it imports once for all that follow, and not into the tree.
    sys.dont_write_bytecode = False
    sys.pycache_prefix = folder
    for name in _LIBRARIES:
        importlib.import_module(name)


def tested(module: Path, source: str | None, tests: tuple[str, ...], cpu_seconds: int) -> Outcome:
    """Run test files with a module's source replaced.

    Args:
        module: the module's file.
        source: what stands in its place; None: the module itself.
        tests: paths below `tests/`.
        cpu_seconds: after which the run is ended, or after ten times as long on the clock.
    """
    with tempfile.TemporaryFile() as output, tempfile.TemporaryDirectory(prefix="mutant_") as folder:
        child = os.fork()
        if child == 0:
            _become(module, source, tests, cpu_seconds, output.fileno(), folder)
        latest = time.monotonic() + 10 * cpu_seconds
        while not os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            if time.monotonic() > latest:
                os.kill(child, signal.SIGKILL)
            time.sleep(0.02)
        _, status, usage = os.wait4(child, 0)
        output.seek(0)
        text = output.read().decode(errors="replace")
    code = os.waitstatus_to_exitcode(status)
    kinds = {0: PASSED, _NOT_LOADED: NEVER, -signal.SIGXCPU: TIME, -signal.SIGKILL: TIME}
    return Outcome(kinds.get(code, FAILED), usage.ru_utime + usage.ru_stime, text)


_NOT_LOADED = 77


def _become(
    module: Path, source: str | None, tests: tuple[str, ...], cpu_seconds: int, output: int, folder: str
) -> None:
    """Turn this child into a run of pytest; does not return."""
    code = 99
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_seconds, cpu_seconds + 5))
        resource.setrlimit(resource.RLIMIT_AS, (_MEGABYTES << 20,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(ROOT)
        os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = f"{folder}/hypothesis"
        os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
        if source is not None:
            _replace(module, source)
        code = _pytest(tests, folder)
        if source is not None and code == 0 and not _is_loaded(module):
            code = _NOT_LOADED
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        os._exit(code)


def _pytest(tests: tuple[str, ...], folder: str) -> int:
    import hypothesis
    import pytest

    # The same examples each time, and no search for the smallest that fails.
    phases = [hypothesis.Phase.explicit, hypothesis.Phase.generate]
    hypothesis.settings.register_profile("mutation", phases=phases, derandomize=True, database=None)
    # Plain assertions, since nobody reads them: rewriting them takes longer than most tests.
    options = ["-q", "-x", "--tb=line", "--assert=plain", f"--basetemp={folder}/tmp", "-p", "no:cacheprovider"]
    options += ["-p", "pytest_timeout", "-p", "_hypothesis_pytestplugin", "--hypothesis-profile=mutation"]
    return int(pytest.main([*options, *(str(ROOT / "tests" / name) for name in tests)]))


def _replace(module: Path, source: str) -> None:
    """Let the import of a module's file see another source, whichever loader imports it, and no compiled file of it."""
    path, compiled = str(module), f"{module.stem}.cpython-"
    get_data = SourceFileLoader.get_data

    def changed_data(self: SourceFileLoader, asked: str) -> bytes:
        if asked == path:
            return source.encode()
        if os.path.basename(asked).startswith(compiled) and str(module.parent) in asked:
            raise OSError("is not that of the mutant")
        return get_data(self, asked)

    def not_kept(self: SourceFileLoader, source_path: str, bytecode_path: str, data: bytearray) -> None:
        pass

    SourceFileLoader.get_data = changed_data  # type: ignore[method-assign]
    SourceFileLoader._cache_bytecode = not_kept  # type: ignore[attr-defined]


def _is_loaded(module: Path) -> bool:
    name = ".".join(module.relative_to(ROOT / "src").with_suffix("").parts)
    return hasattr(sys.modules.get(name), MARK)
