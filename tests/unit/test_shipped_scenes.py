"""Every scene in `scenes/`: it loads, its check has nothing to say, and its files are what the README promises."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fd_mitsuba.config import RunConfig
from fd_mitsuba.prior.data.captions import vocabulary
from fd_mitsuba.runs.check import check_scene
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.scene_file import SceneFile, ready_mitsuba

SCENES = Path(__file__).resolve().parents[2] / "scenes"
NAMES = sorted(path.parent.name for path in SCENES.glob("*/scene.xml"))
OPEN = {"stump_butterfly"}
FOR_STABLE_DIFFUSION = {"cup_straw", "stump_butterfly"}
"""Their prompts hold words that the built-in prior has never read; their READMEs say so."""


@pytest.fixture(scope="module")
def loaded() -> dict[str, EditScene]:
    return {name: load_edit_scene(SCENES / name / "scene.xml") for name in NAMES}


def ply_header(path: Path) -> tuple[list[str], int]:
    """Names of the vertex properties, and the number of faces."""
    header = path.read_bytes().split(b"end_header")[0].decode("ascii")
    return re.findall(r"property float (\w+)", header), int(re.search(r"element face (\d+)", header)[1])


def test_there_are_fifteen() -> None:
    assert len(NAMES) == 15


def test_check_is_clean(loaded: dict[str, EditScene]) -> None:
    for name, scene in loaded.items():
        report = check_scene(scene, RunConfig.load("quick"))
        expected = ["not closed"] if name in OPEN else []
        assert len(report.warnings) == len(expected), (name, report.warnings)
        assert all(words in warning for words, warning in zip(expected, report.warnings, strict=True))
        assert all(region.share_in_grid > 0.995 and region.gap_to_base == 0 for region in report.regions), name
        assert all(mesh.volume > 0 for mesh in report.base), name
        assert 2_000 <= sum(mesh.faces for mesh in report.base) <= 50_000, name


def test_uvs_cover_a_texture_without_leaving_it(loaded: dict[str, EditScene]) -> None:
    for name, scene in loaded.items():
        for mesh in scene.base:
            names, _ = ply_header(mesh.source_files[0])
            assert {"s", "t", "nx", "ny", "nz"} <= set(names), (name, mesh.name)
            raw = mesh.source_files[0].read_bytes()
            start = raw.index(b"end_header\n") + len(b"end_header\n")
            count = int(re.search(rb"element vertex (\d+)", raw[:start])[1])
            vertex = np.frombuffer(raw, "<f4", count * len(names), start).reshape(count, -1)
            uv = vertex[:, [names.index("s"), names.index("t")]]
            assert uv.min() >= 0 and uv.max() <= 1 and np.ptp(uv, axis=0).min() > 0.7, (name, mesh.name)


def test_textures_have_the_promised_sizes() -> None:
    for name in NAMES:
        pictures = sorted((SCENES / name).glob("*.png"))
        assert pictures, name
        text = (SCENES / name / "scene.xml").read_text()
        for path in pictures:
            with Image.open(path) as picture:
                assert picture.width == picture.height
                expected = ("L", 256, 512) if "roughness" in path.name else ("RGB", 512, 1024)
                assert picture.mode == expected[0] and expected[1] <= picture.width <= expected[2], path
            assert path.name in text, f"{path} is not used"


def test_materials_and_lights_vary() -> None:
    texts = {name: (SCENES / name / "scene.xml").read_text() for name in NAMES}
    assert sum("roughplastic" in text or "roughconductor" in text for text in texts.values()) >= 2
    assert sum('<emitter type="area">' in text and "envmap" not in text for text in texts.values()) >= 1
    assert any("vertex_color" in text for text in texts.values())
    assert any(
        re.search(r'"focal_region"[^>]*>\s*(<string name="part"[^>]*>\s*)?<string name="filename"', text)
        for text in texts.values()
    )
    lights = {light for text in texts.values() for light in re.findall(r"lighting/(\w+)\.exr", text)}
    assert len(lights) >= 5 and lights < {path.stem for path in (SCENES / "lighting").glob("*.exr")}


def test_prompts_are_complete_and_known_to_the_prior_or_declared(loaded: dict[str, EditScene]) -> None:
    known = set(vocabulary())
    for name, scene in loaded.items():
        integrator = SceneFile(scene.path).top_level("integrator")[0]
        simple = integrator.properties["simple_prompt"]
        assert simple and scene.base_prompt and scene.base_prompt != scene.prompt
        assert len(simple.split()) <= len(scene.prompt.split())
        unknown = {word for text in (scene.prompt, simple) for word in text.split()} - known
        assert bool(unknown) == (name in FOR_STABLE_DIFFUSION), (name, unknown)
        if unknown:
            assert "Stable Diffusion" in " ".join((SCENES / name / "README.md").read_text().split())


def test_every_scene_has_a_readme_and_a_place_on_the_sheet() -> None:
    overview = (SCENES / "README.md").read_text()
    for name in NAMES:
        text = (SCENES / name / "README.md").read_text()
        assert "CC0" in text and "fd_mitsuba run" in text, name
        assert f"({name}/)" in overview, name
    assert (SCENES / "scenes.jpg").stat().st_size <= 600_000


def test_the_integrator_keeps_the_simple_prompt() -> None:
    mi = ready_mitsuba()
    integrator = mi.load_dict({"type": "dual_path", "prompt": "a tall horse", "simple_prompt": "a horse"})
    assert integrator.simple_prompt == "a horse"
    assert mi.load_dict({"type": "dual_path", "prompt": "a tall horse"}).simple_prompt == ""
