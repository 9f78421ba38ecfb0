"""Bad input on the command line: exit 1 (2 for usage), one line with file, element and remedy, nothing half-written."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_pipelines import save_pipeline

from fd_mitsuba.cli.main import main
from fd_mitsuba.training.checkpoint import list_checkpoints

Make = Callable[..., Path]
TINY = [
    *("field.levels=2", "field.log2_table=8", "geometry.steps=4", "geometry.grid_resolution=16", "geometry.views=1"),
    *("geometry.spp=1", "geometry.lambda_sds=0", "output.turntable_frames=2", "output.turntable_size=16"),
    "output.picture_size=0",
]


@pytest.fixture
def scene(make_scene: Make) -> Path:
    return make_scene()


def call(capfd: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    """Exit code and the one line on stderr of a command that must fail; what C++ code prints counts too."""
    try:
        code = main([str(word) for word in words])
    except SystemExit as stop:
        code = stop.code
    out, err = capfd.readouterr()
    assert out == "" and err.count("\n") == 1 and "Traceback" not in err, (out, err)
    assert err.startswith("fd_mitsuba") and len(err) < 600
    return code, err


def run(scene: object, output: Path, *more: object) -> list[object]:
    return [
        "run",
        scene,
        "-c",
        "quick",
        "-q",
        "--stage",
        "geometry",
        "-o",
        output,
        *[word for item in TINY for word in ("--set", item)],
        *more,
    ]


def litter(folder: Path) -> list[Path]:
    return list(folder.rglob("*.tmp"))


USAGE = {
    "no command": [],
    "unknown command": ["grow", "scene.xml"],
    "no scene": ["run"],
    "unknown option": ["run", "scene.xml", "--colour"],
    "threads that are no number": ["run", "scene.xml", "-t", "many"],
    "option without its value": ["run", "scene.xml", "-o"],
    "two scenes": ["check", "a.xml", "b.xml"],
    "threads of thousands of digits": ["run", "scene.xml", "-t", "9" * 5000],
    "a seed of thousands of digits": ["batch", "scene.xml", "-o", "out", "--seeds", "9" * 5000],
}


@pytest.mark.parametrize("name", USAGE)
def test_usage(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    code, line = call(capfd, *USAGE[name])
    assert code == 2 and "--help" in line


# name: (words after `run SCENE -o OUT`, words that the message must hold)
OPTIONS: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "unknown --set key": (["--set", "geometry.step=3"], ("geometry.step", "nearest: geometry.steps")),
    "unknown --set section": (["--set", "geometri.steps=3"], ("geometri", "unknown key")),
    "--set without =": (["--set", "geometry.steps"], ("--set geometry.steps", "section.key=value")),
    "--set of a wrong type": (["--set", "geometry.steps=many"], ("geometry.steps", "many")),
    "negative weight": (["--set", "geometry.lambda_focal=-1"], ("geometry.lambda_focal", "change the value")),
    "NaN weight": (["--set", "geometry.lambda_focal=nan"], ("geometry.lambda_focal",)),
    "missing config": (["-c", "none.toml"], ("none.toml", "no such config file")),
    "config that is a folder": (["-c", "/"], ("/", "is a folder")),
    "unknown -D": (["-D", "promt=x"], ("promt", "scene.xml")),
    "-D without =": (["-D", "prompt"], ("-D prompt", "name=value")),
    "-D without a name": (["-D", "=x"], ("-D =x", "name=value")),
    "scalar variant": (["-m", "scalar_rgb"], ("scalar_rgb", "llvm_ad_rgb")),
    "unknown variant": (["-m", "llvm_rbg"], ("llvm_rbg", "choose one of")),
    "negative threads": (["-t", "-2"], ("-t -2", "0 (all cores)")),
    "threads without end": (["-t", "100000"], ("-t 100000", "at most")),
    "samples without end": (["--set", "appearance.spp=1000000000"], ("appearance.spp", "less than or equal to 4096")),
    "weight without end": (["--set", "geometry.lambda_focal=1e300"], ("lambda_focal", "less than or equal to")),
    "seed of thousands of digits": (["--set", "seed=" + "9" * 5000], ("--set seed=9", "equal to 2147483647")),
    "blank prompt": (["--prompt", "  "], ("--prompt", "blank")),
    "empty prompt": (["--prompt", ""], ("--prompt", "blank")),
    "model that is nowhere": (["--set", "guidance.model=./none"], ("./none", "guidance.model")),
    "model that is a file": (["--set", "guidance.model=/etc/hostname"], ("/etc/hostname", "is a file")),
    "model folder that is empty": (["--set", "guidance.model=empty"], ("empty", "model_index.json")),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options(
    name: str, scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    more, words = OPTIONS[name]
    if "guidance" in more[-1]:
        more = ["--set", "geometry.lambda_sds=1", *more]
    code, line = call(capfd, *run(scene, tmp_path / "out", *more))
    assert code == 1
    for word in words:
        assert word in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["run", "check", "preview"])
def test_missing_scene(command: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, line = call(capfd, command, tmp_path / "none.xml")
    assert code == 1 and "none.xml: no such scene file" in line


def test_preview_wants_a_folder(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["preview", "scene.xml", "-o", str(tmp_path / "out.png")]) == 1
    assert "out.png: names the folder of the images" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("place", "mode"),
    [
        ('<scale value="0.1"/><translate x="40"/>', "add"),
        pytest.param('<scale value="0.1"/><translate x="0.3" y="1.1"/>', "add", marks=pytest.mark.slow),
        pytest.param('<scale value="30"/>', "add", marks=pytest.mark.slow),
        ('<scale value="0.04"/><translate x="0.55" y="0.5" z="-0.4"/>', "subtract"),
    ],
)
def test_preview_shows_a_misplaced_region(
    make_scene: Make, tmp_path: Path, capfd: pytest.CaptureFixture[str], place: str, mode: str
) -> None:
    inner = f'<string name="mode" value="{mode}"/><transform name="to_world">{place}</transform>'
    scene = make_scene(region=f'<shape type="focal_region" id="wing">{inner}</shape>')
    assert main(["preview", str(scene), "-o", str(tmp_path / "out")]) == 1
    out, err = capfd.readouterr()
    assert out.splitlines()[0] == str(tmp_path / "out" / "preview.png") and "base x" in out
    assert (tmp_path / "out" / "preview.png").is_file()
    assert err.count("\n") == 1 and "scene.xml" in err and 'id="wing"' in err and "move" in err


@pytest.mark.parametrize("content", ["steps = ", "[geometry\n", "geometry = 3\n", "[output]\nsheet = 3\n"])
def test_bad_config_file(scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], content: str) -> None:
    (tmp_path / "bad.toml").write_text(content)
    code, line = call(capfd, "run", scene, "-o", tmp_path / "out", "-c", tmp_path / "bad.toml")
    assert code == 1 and "bad.toml" in line and not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_pipeline("sd15", tmp_path_factory.mktemp("pipeline") / "sd15")


@pytest.mark.parametrize(
    "missing", ["unet", "unet/diffusion_pytorch_model.safetensors", "tokenizer", "vae/config.json"]
)
def test_model_folder_that_lacks_something(
    pipeline: Path, missing: str, scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(pipeline, tmp_path / "model")
    target = folder / missing
    shutil.rmtree(target) if target.is_dir() else target.unlink()
    more = ["--set", "geometry.lambda_sds=1", "--set", f"guidance.model={folder}"]
    code, line = call(capfd, *run(scene, tmp_path / "out", *more))
    assert code == 1 and str(folder / missing.split("/")[0]) in line
    assert not (tmp_path / "out").exists()  # so that the next try with a whole model needs no other folder


@pytest.mark.parametrize("output", ["file", "file/below", "/proc/fd_mitsuba/out", "/sys/fd_mitsuba"])
def test_output_that_cannot_be_written(
    output: str, scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("precious")
    code, line = call(capfd, *run(scene, tmp_path / output))
    assert code == 1 and str(tmp_path / output) in line and "choose another -o folder" in line
    assert (tmp_path / "file").read_text() == "precious"


def test_a_material_that_cannot_be_learned_is_said_before_the_shape_is_made(
    make_scene: Make, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    glass = make_scene(part='<bsdf type="dielectric" id="part"/>')
    words = [word for item in (*TINY, "appearance.lambda_sds=0") for word in ("--set", item)]
    code, line = call(capfd, "run", glass, "-q", "-o", tmp_path / "out", *words)
    assert code == 1 and "nothing to learn" in line and not (tmp_path / "out").exists()


@pytest.mark.parametrize("resume", [(), ("--resume",)])
def test_output_folder_of_something_else(
    scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], resume: tuple[str, ...]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("precious")
    code, line = call(capfd, *run(scene, tmp_path / "out", *resume))
    assert code == 1 and "not empty and not a run" in line
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]


NUMBERS: dict[str, tuple[list[str], str]] = {
    "batch --workers": (["batch", "SCENE", "-o", "OUT", "--workers", "1000000000"], "at most 1024"),
    "batch --seeds": (["batch", "SCENE", "-o", "OUT", "--seeds", "99999999999"], "less than or equal to 2147483647"),
    "batch -t": (["batch", "SCENE", "-o", "OUT", "-t", "100000"], "give 1 to"),
    "evaluate --views": (["evaluate", "OUT", "--views", "1000000000"], "at most 10000"),
    "evaluate --spp": (["evaluate", "OUT", "--spp", "1000000000"], "at most 10000, 2048 and 4096"),
    "render --size": (["render", "OUT", "--size", "1000000"], "at most 1000, 4096"),
    "render samples": (["render", "OUT", "--size", "4096", "--spp", "65536"], "more than Dr.Jit can number"),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_without_end(name: str, scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words, said = NUMBERS[name]
    places = {"SCENE": str(scene), "OUT": str(tmp_path / "out")}
    code, line = call(capfd, *[places.get(word, word) for word in words])
    assert code == 1 and said in line and words[-2].strip("-").rstrip("s") in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", ["", "{", "[]", "null"])
def test_resume_of_a_folder_with_a_damaged_record(
    scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], content: str
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.json").write_text(content)
    code, line = call(capfd, *run(scene, tmp_path / "out", "--resume"))
    assert code == 1 and "run.json: cannot be read" in line


class FullDisk:
    """`os.fsync` of a disk that takes so many files, then no more; fsync is where a delayed write fails."""

    def __init__(self, files: int) -> None:
        self.left = files
        self.real = os.fsync

    def __call__(self, descriptor: int) -> None:
        self.left -= 1
        if self.left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.real(descriptor)


@pytest.mark.parametrize("files", [0, 3, 5, 6, 7, 8, 9, 11, 12, 13, 14])
def test_disk_that_fills_up(
    scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, files: int
) -> None:
    main(["check", str(scene)])  # so that the base's distances are cached, and every write is the run's own
    capfd.readouterr()
    words = run(scene, tmp_path / "out", "--set", "output.checkpoint_every=2")
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", FullDisk(files))
        code, line = call(capfd, *words)
    assert code == 1 and "No space left on device" in line and "free space" in line
    assert not litter(tmp_path / "out")
    for path in (tmp_path / "out").rglob("*.json"):
        json.loads(path.read_text())
    if files in (0, 8):  # with space again, the run goes on to its end
        assert main([str(word) for word in [*words, "--resume"]]) == 0
        assert list_checkpoints(tmp_path / "out" / "checkpoints")[-1].stem == "step_000004"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_metrics_on_a_full_disk(
    scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from fd_mitsuba.training import record

    monkeypatch.setattr(record, "open", lambda path, *rest, **named: open("/dev/full", "w"), raising=False)  # noqa: SIM115
    code, line = call(capfd, *run(scene, tmp_path / "out"))
    assert code == 1 and "No space left on device" in line and "free space" in line


def test_verbose_shows_the_traceback(tmp_path: Path) -> None:
    from fd_mitsuba.errors import UserError

    with pytest.raises(UserError):
        main(["check", str(tmp_path / "none.xml"), "-v"])


@pytest.mark.parametrize("command", ["check", "preview", "run"])
def test_interrupt_outside_the_loop(
    command: str, scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("fd_mitsuba.scene.load_scene.load_edit_scene", interrupt)
    code, line = call(capfd, command, scene)
    assert code == 130 and "interrupted" in line and ("--resume" in line) == (command == "run")
