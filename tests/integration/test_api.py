"""The package as a library: a scene is edited from Python, by settings and guidance of the caller's own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import fd_mitsuba as fd
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceResult, GuidanceViews, Phase

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes" / "cat" / "scene.xml"
TINY = ["geometry.steps=3", "appearance.steps=2", "output.turntable_frames=2", "output.texture_size=64"]
TINY += ["output.faces=1000"]


class Darker:
    """A guidance that wants less coverage; not derived from anything of the package."""

    needs_base = False
    view_grid = 1
    normal_space = None
    appearance_size = 32

    def __init__(self) -> None:
        self.prompt, self.asked = "", []

    def picture_size(self, phase: Phase) -> int:
        return 24

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        self.prompt = prompt
        return []

    def guide(self, views: GuidanceViews, step: int, steps_total: int, phase: Phase, seed: int) -> GuidanceResult:
        self.asked.append((phase, step, tuple(views.pictures.shape)))
        return GuidanceResult(views.pictures[:, 3].mean(), {"coverage": float(views.pictures[:, 3].detach().mean())})

    def guide_appearance(self, views: AppearanceViews, step: int, steps_total: int, seed: int) -> GuidanceResult:
        self.asked.append(("appearance", step, tuple(views.pictures.shape)))
        return GuidanceResult(views.pictures.mean())


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> tuple[fd.Run, Darker, list]:
    guidance, updates = Darker(), []
    scene = fd.load_scene(SCENE, prompt="a cat with an untold thing")
    folder = tmp_path_factory.mktemp("api") / "run"
    run = fd.edit(
        scene,
        fd.Config.load("smoke", TINY),
        output=folder,
        guidance=guidance,
        on_step=lambda update: updates.append(
            (update.stage, update.step, update.total, update.live.surface().faces.shape[1])
            if update.stage == "geometry"
            else (update.stage, update.step, update.total, 0)
        ),
        quiet=True,
    )
    return run, guidance, updates


def test_a_callers_guidance_serves_both_stages(edited: tuple[fd.Run, Darker, list]) -> None:
    run, guidance, _ = edited
    assert guidance.prompt == "a cat with an untold thing"
    assert [kind for kind, *_ in guidance.asked] == ["coarse", "coarse", "refined", "appearance", "appearance"]
    assert guidance.asked[0][2] == (4, 5, 24, 24) and guidance.asked[-1][2] == (4, 3, 32, 32)
    assert run.metrics["guidance_model"].endswith("Darker")
    rows = [json.loads(line) for line in (run.folder / "metrics.jsonl").read_text().splitlines()]
    assert rows[0]["coverage"] > 0


def test_every_step_is_told(edited: tuple[fd.Run, Darker, list]) -> None:
    assert edited[2] == [("geometry", n, 3, 3) for n in (1, 2, 3)] + [("appearance", n, 2, 0) for n in (1, 2)]


def test_the_run_holds_all_that_the_command_writes(edited: tuple[fd.Run, Darker, list]) -> None:
    run = edited[0]
    assert run.finished and run.prompt == "a cat with an untold thing" and run.parts == ["part"]
    for name in ("report.html", "metrics.json", "export/asset.glb", "export/part_part.ply", "images/appearance.png"):
        assert (run.folder / name).is_file(), name


def test_a_run_can_be_opened_again(edited: tuple[fd.Run, Darker, list]) -> None:
    run = fd.Run.open(edited[0].folder)
    part = run.part()
    assert part.is_watertight and len(part.faces) == run.metrics["part_faces"]["part"]
    assert run.part("part").volume == part.volume
    files = run.export(["ply"], faces=400)
    assert files and all(path.is_file() for path in files)
    assert run.show() == run.folder / "images" / "appearance.png"


def test_what_is_not_there_is_named(edited: tuple[fd.Run, Darker, list], tmp_path: Path) -> None:
    with pytest.raises(fd.UserError, match="no part 'wing'; its parts: part"):
        edited[0].part("wing")
    with pytest.raises(fd.UserError, match="not a run"):
        fd.Run.open(tmp_path)
    with pytest.raises(fd.UserError, match="is blank"):
        fd.load_scene(SCENE, prompt="  ")
    with pytest.raises(fd.UserError, match="prompt: has 3002 characters; describe"):
        fd.load_scene(SCENE, prompt="a cat with " + "a crown " * 374)
    with pytest.raises(fd.UserError, match="stages = .'texture'.: give any of geometry, appearance"):
        fd.edit(fd.load_scene(SCENE), fd.Config.load("smoke"), output=tmp_path / "run", stages=["texture"])


def test_quiet_is_silent(
    edited: tuple[fd.Run, Darker, list], capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    settings = fd.Config.load("smoke", [*TINY, "geometry.steps=1", "output.picture_size=0"])
    fd.edit(fd.load_scene(SCENE), settings, output=tmp_path / "run", guidance=Darker(), stages=["geometry"], quiet=True)
    assert capfd.readouterr() == ("", "")


def test_what_the_callback_raises_ends_the_run(tmp_path: Path) -> None:
    def stop(update: object) -> None:
        raise KeyError("enough")

    with pytest.raises(KeyError, match="enough"):
        fd.edit(
            fd.load_scene(SCENE),
            fd.Config.load("smoke", [*TINY, "output.picture_size=0"]),
            output=tmp_path / "run",
            guidance=Darker(),
            on_step=stop,
            quiet=True,
        )


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, fd_mitsuba; print(sorted({'torch', 'mitsuba', 'numpy', 'pydantic'} & set(sys.modules)))"
    started = time.perf_counter()
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (result.stdout.strip(), result.stderr) == ("[]", "") and time.perf_counter() - started < 10


def test_public_names_are_listed_and_found() -> None:
    assert set(fd.__all__) <= set(dir(fd))
    assert all(getattr(fd, name) is not None for name in fd.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = fd.nothing
    assert torch.is_tensor(torch.zeros(1))
