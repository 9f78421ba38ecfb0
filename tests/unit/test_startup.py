"""Choice of LLVM and start of Mitsuba, each in a process of its own: both happen once per process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fd_mitsuba.backend import startup
from fd_mitsuba.errors import UserError


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    env = {key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"} | environment
    source = str(Path(startup.__file__).parents[2])
    env["PYTHONPATH"] = os.pathsep.join([source, env.get("PYTHONPATH", "")])
    return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=120)


def fake_llvm(path: Path, version: str | None) -> Path:
    marker = b"" if version is None else b"\0LLVM_" + version.encode() + b"\0"
    path.write_bytes(b"\x7fELF" + bytes(100) + marker + bytes(100))
    return path


def only_these(monkeypatch: pytest.MonkeyPatch, *paths: Path) -> None:
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(startup, "_candidates", lambda: list(paths))


def test_takes_the_newest_and_dr_jit_uses_it() -> None:
    result = run(
        "from fd_mitsuba.backend import startup as a; import os, sys\n"
        "found = a.find_llvm(); assert 'drjit' not in sys.modules\n"
        "assert all(found.version >= other.version for other in a.installed_llvms())\n"
        "mi = a.start(threads=1); import drjit as dr\n"
        "assert os.environ['DRJIT_LIBLLVM_PATH'] == str(found.path)\n"
        "assert dr.detail.llvm_version()[0] == found.version[0] >= 16\n"
        "assert mi.variant() == 'llvm_ad_rgb' and dr.thread_count() == 1\n"
        "assert a.start() is mi and dr.thread_count() == 1\n"
        "print(dr.sum(mi.Float([1, 2, 3]))[0])"
    )
    assert (result.returncode, result.stdout.strip(), result.stderr) == (0, "6.0", "")


@pytest.mark.parametrize("first", ["mi.set_variant('llvm_ad_rgb'); import fd_mitsuba", "import fd_mitsuba"])
def test_plugins_are_known_once_the_package_is_imported_after_mitsuba(first: str) -> None:
    llvm = str(startup.find_llvm().path)
    load = "type(mi.load_dict({'type': 'dual_path'})).__name__"
    code = f"import mitsuba as mi; {first}; mi.set_variant('llvm_ad_rgb'); one = {load}; "
    result = run(code + f"mi.set_variant('llvm_ad_mono'); print(one, {load})", DRJIT_LIBLLVM_PATH=llvm)
    assert (result.returncode, result.stdout.split()) == (0, ["DualPath", "DualPath"]), result.stderr


def test_importing_the_package_alone_leaves_mitsuba_alone() -> None:
    assert run("import fd_mitsuba, sys; print('mitsuba' in sys.modules)").stdout.strip() == "False"


def test_importing_the_renderer_first_is_safe_too() -> None:
    code = "from fd_mitsuba.render.geometry_pass import GeometryPass; GeometryPass(4); import drjit as dr\n"
    assert run(code + "print(dr.detail.llvm_version()[0] >= 16)").stdout.strip() == "True"


def test_newest_by_number_and_symbol_version_before_file_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nine = fake_llvm(tmp_path / "libLLVM-9.so.1", None)
    seventeen = fake_llvm(tmp_path / "libLLVM-17.so", None)
    misnamed = fake_llvm(tmp_path / "libLLVM-99.so", "15")
    only_these(monkeypatch, nine, seventeen, misnamed)
    assert startup.find_llvm() == startup.LlvmLibrary((17, 0, 0), seventeen)
    assert [item.version[0] for item in startup.installed_llvms()] == [9, 15, 17]


def test_links_to_one_file_count_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = fake_llvm(tmp_path / "libLLVM.so.18.1", "18.1")
    link = tmp_path / "libLLVM.so"
    link.symlink_to(real)
    only_these(monkeypatch, link, real, tmp_path / "libLLVM-missing.so")
    assert [item.path for item in startup.installed_llvms()] == [real.resolve()]


@pytest.mark.parametrize("version", ["14", "15"])
def test_only_old_libraries(version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    only_these(monkeypatch, fake_llvm(tmp_path / "libLLVM.so.1", version))
    with pytest.raises(UserError, match=rf"^LLVM: the newest here is LLVM {version}\..*apt-get install libllvm19"):
        startup.find_llvm()


def test_no_library(monkeypatch: pytest.MonkeyPatch) -> None:
    only_these(monkeypatch)
    with pytest.raises(UserError, match="no libLLVM found.*apt-get install libllvm19"):
        startup.find_llvm()


def test_a_path_given_by_the_user_is_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = tmp_path / "libLLVM-18.so"
    text.write_text("not a library")
    cases = {
        str(tmp_path / "missing.so"): "no such file",
        str(fake_llvm(tmp_path / "libLLVM-15.so.1", "15")): "LLVM 15 is too old",
        str(text): "not a readable libLLVM",
    }
    for path, reason in cases.items():
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", path)
        with pytest.raises(UserError, match=rf"^DRJIT_LIBLLVM_PATH={path}: {reason}") as caught:
            startup.find_llvm()
        assert "\n" not in str(caught.value)
    good = fake_llvm(tmp_path / "mine.so", "18.1")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(good))
    assert startup.find_llvm() == startup.LlvmLibrary((18, 1, 0), good)


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        ("variant='llvm_rgb'", "variant 'llvm_rgb': unknown to this Mitsuba; choose one of"),
        ("variant='scalar_rgb'", "variant 'scalar_rgb': gradients need an llvm_ad_* variant"),
        ("threads=-1", "threads = -1"),
    ],
)
def test_bad_arguments_give_one_line(call: str, reason: str) -> None:
    result = run(
        "from fd_mitsuba.backend import startup as a\nfrom fd_mitsuba.errors import UserError\n"
        f"try: a.start({call})\nexcept UserError as error: print(error)"
    )
    assert result.stdout.startswith(reason) and result.stdout.count("\n") == 1 and result.stderr == ""


@pytest.mark.parametrize("given", [{}, {"DRJIT_LIBLLVM_PATH": "/nowhere.so"}])
def test_a_card_that_is_not_there_is_one_line(given: dict[str, str]) -> None:
    """Whether or not an LLVM is found: a CUDA variant does not need it."""
    result = run(
        "from fd_mitsuba.backend import startup as a\nfrom fd_mitsuba.errors import UserError\n"
        "try: a.start('cuda_ad_rgb'); print('there is a card')\nexcept UserError as error: print(error)",
        **given,
    )
    if "there is a card" in result.stdout:
        pytest.skip("this machine has a card")
    assert result.stdout.startswith("variant 'cuda_ad_rgb': Dr.Jit finds no NVIDIA card"), result.stderr
    assert result.stdout.count("\n") == 1 and "use llvm_ad_rgb" in result.stdout


def test_another_variant_in_the_same_process_is_refused() -> None:
    result = run(
        "from fd_mitsuba.backend import startup as a\nfrom fd_mitsuba.errors import UserError\na.start()\n"
        "try: a.start('llvm_ad_spectral')\nexcept UserError as error: print(error)"
    )
    assert "llvm_ad_rgb is already in use" in result.stdout
