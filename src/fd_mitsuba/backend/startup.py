"""The one file that changes with the Mitsuba version: which LLVM, which variant, which parameter names.

Dr.Jit reads `DRJIT_LIBLLVM_PATH` while it is being imported, and takes LLVM 15, which then aborts the process on
Mitsuba's own kernels. So the library is chosen here first; `import drjit` and `import mitsuba` come after.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from fd_mitsuba.errors import UserError

OLDEST_LLVM = 16
"""LLVM 14 is refused by Dr.Jit 1.5; 15 cannot compile `fminimum` on x86 and aborts the process."""

DEFAULT_VARIANT = "llvm_ad_rgb"

NO_CARD = "Dr.Jit finds no NVIDIA card, or no driver of version 535 or newer for it"

VERTICES = "vertex_positions"
FACES = "faces"
NORMALS = "vertex_normals"
UVS = "vertex_texcoords"
"""Parameter names of `mi.Mesh` in Mitsuba 3.9 (3.10 renames them)."""

_REMEDY = "run `apt-get install libllvm19`, or point DRJIT_LIBLLVM_PATH at a libLLVM of version 16 or newer"
_HEAD_BYTES = 1 << 23  # the dynamic symbol versions lie within the first megabytes of every libLLVM


@dataclass(frozen=True, order=True)
class LlvmLibrary:
    """A shared libLLVM on this machine."""

    version: tuple[int, int, int]
    """Major, minor, patch; 0 where the file does not tell."""
    path: Path

    def __str__(self) -> str:
        return f"LLVM {'.'.join(map(str, self.version))} ({self.path})"


def find_llvm() -> LlvmLibrary:
    """The library that Dr.Jit is to use: the one in `DRJIT_LIBLLVM_PATH` if set, else the newest on the machine.

    Searched: the system's library folders, `/usr/lib/llvm-*/lib`, and the wheel `llvm-nanobind` where it is installed.
    Files are read, never loaded: two libLLVM in one process do not get on.

    Raises:
        UserError: none of version 16 or newer, or `DRJIT_LIBLLVM_PATH` names a missing, unreadable or older one.
    """
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        path = Path(given)
        if not path.is_file():
            raise UserError(f"DRJIT_LIBLLVM_PATH={given}: no such file; unset it, or {_REMEDY}")
        version = _version_of(path)
        if version is None:
            raise UserError(f"DRJIT_LIBLLVM_PATH={given}: not a readable libLLVM; unset it, or {_REMEDY}")
        if version[0] < OLDEST_LLVM:
            raise UserError(f"DRJIT_LIBLLVM_PATH={given}: LLVM {version[0]} is too old; unset it, or {_REMEDY}")
        return LlvmLibrary(version, path)
    found = installed_llvms()
    if not found:
        raise UserError(f"LLVM: no libLLVM found on this machine; {_REMEDY}")
    if found[-1].version[0] < OLDEST_LLVM:
        raise UserError(f"LLVM: the newest here is {found[-1]}, which is too old; {_REMEDY}")
    return found[-1]


def installed_llvms() -> list[LlvmLibrary]:
    """Every libLLVM in the searched folders, oldest first, each real file once."""
    real_files = {path.resolve() for path in _candidates() if path.is_file()}
    libraries = [LlvmLibrary(version, path) for path in real_files if (version := _version_of(path))]
    return sorted(libraries)


def choose_llvm() -> LlvmLibrary:
    """`find_llvm()`, written to `DRJIT_LIBLLVM_PATH` where Dr.Jit will read it. Call before the first `import drjit`.

    Raises:
        UserError: as `find_llvm`.
    """
    library = find_llvm()
    os.environ["DRJIT_LIBLLVM_PATH"] = str(library.path)
    return library


def start(variant: str = DEFAULT_VARIANT, threads: int = 0) -> ModuleType:
    """The module `mitsuba`, with its variant set, its log quiet and its thread pool sized. May be called again.

    Args:
        variant: with derivatives: `llvm_ad_*` on the CPU, `cuda_ad_*` on an NVIDIA card (never tried on one).
        threads: cores to use, the calling thread included; 0 keeps the present number (at first all cores).

    Raises:
        UserError: unknown variant, unsuitable variant, another variant already set, negative `threads`, no usable LLVM,
            no card for a CUDA variant.
    """
    if threads < 0:
        raise UserError(f"threads = {threads}: give 0 (all cores) or a positive number")
    on_card = variant.startswith("cuda_ad_")
    if "drjit" not in sys.modules:
        with contextlib.suppress(UserError) if on_card else contextlib.nullcontext():
            choose_llvm()
    import drjit as dr
    import mitsuba as mi

    if variant not in mi.variants():
        raise UserError(f"variant {variant!r}: unknown to this Mitsuba; choose one of {', '.join(mi.variants())}")
    if not variant.startswith(("llvm_ad_", "cuda_ad_")):
        raise UserError(
            f"variant {variant!r}: gradients need an llvm_ad_* variant, or cuda_ad_* on an NVIDIA card; use "
            f"{DEFAULT_VARIANT}"
        )
    current = mi.variant()
    if current is None:
        try:
            mi.set_variant(variant)
        except ImportError as error:
            if on_card:
                raise UserError(f"variant {variant!r}: {NO_CARD}; use {DEFAULT_VARIANT}") from None
            path = os.environ.get("DRJIT_LIBLLVM_PATH")
            raise UserError(f"LLVM: Dr.Jit refused {path} ({error}); {_REMEDY}") from None
    elif current != variant:
        raise UserError(f"variant {variant!r}: {current} is already in use in this process; start a new one")
    version = (OLDEST_LLVM, 0, 0) if on_card else dr.detail.llvm_version()
    if version[0] < OLDEST_LLVM:  # Dr.Jit was imported before us and chose for itself
        raise UserError(f"LLVM: Dr.Jit already loaded version {version[0]}; import fd_mitsuba first, or {_REMEDY}")
    mi.set_log_level(mi.LogLevel.Error)  # non-manifold meshes would print themselves whole at every step
    # With more than one thread Dr.Jit would add into a copy a thread where the target is small, and bake the target's
    # size into the kernel: a new kernel for every size of mesh.
    dr.set_expand_threshold(0)
    if threads:
        dr.set_thread_count(threads)
    return mi


def renders_on_card() -> bool:
    """Whether the variant that is set renders on a card, with OptiX in place of Embree."""
    import mitsuba as mi

    return (mi.variant() or DEFAULT_VARIANT).startswith("cuda_")


def _candidates() -> list[Path]:
    machine = platform.machine()
    folders = [Path(f"/usr/lib/{machine}-linux-gnu"), Path("/usr/lib64"), Path("/usr/lib"), Path("/usr/local/lib")]
    folders += [Path(item) for item in os.environ.get("LD_LIBRARY_PATH", "").split(":") if item]
    folders += sorted(Path("/usr/lib").glob("llvm-*/lib")) + sorted(Path("/opt/homebrew/opt").glob("llvm*/lib"))
    patterns = ("libLLVM*.so*", "libLLVM*.dylib")
    files = [path for folder in folders for pattern in patterns for path in folder.glob(pattern)]
    try:
        wheel = importlib.metadata.distribution("llvm-nanobind").files or []
    except importlib.metadata.PackageNotFoundError:
        wheel = []
    return files + [Path(item.locate()) for item in wheel if item.name.startswith("libLLVM")]


def _version_of(path: Path) -> tuple[int, int, int] | None:
    """Version of a libLLVM by its ELF symbol version (`LLVM_19.1`), else by its file name; None if it has neither."""
    try:
        with open(path, "rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return None
    if not head.startswith((b"\x7fELF", b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe")):
        return None
    inside = re.search(rb"\0LLVM_(\d+)(?:\.(\d+))?(?:\.(\d+))?\0", head)
    if inside:
        return _triple(part.decode() if part else None for part in inside.groups())
    named = re.match(r"libLLVM(?:-|\.so\.|\.)(\d+)(?:\.(\d+))?(?:\.(\d+))?", path.resolve().name)
    return _triple(named.groups()) if named else None


def _triple(parts: object) -> tuple[int, int, int]:
    major, minor, patch = (int(part or 0) for part in parts)  # type: ignore[attr-defined]
    return major, minor, patch
