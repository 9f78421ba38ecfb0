"""Regions that fit what the prompt asks for, where nobody says how large they are or where they go."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import fd_mitsuba as fd
from fd_mitsuba.assets.placing import placed_regions, prompted_regions
from fd_mitsuba.cli.main import main
from fd_mitsuba.config import RunConfig
from fd_mitsuba.guidance.builtin import WIDE_FOLDER
from fd_mitsuba.guidance.model_conventions import read_model_conventions
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.guidance.prompted_part import prompted_parts
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.fine.bodies import BODIES as FINE_BODIES
from fd_mitsuba.prior.data.fine.parts import PARTS as FINE_PARTS
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.runs.prompt_fit import prompt_warnings
from fd_mitsuba.scene.region_words import ObjectPlaces
from fd_mitsuba.scene.usual_regions import HEADLESS, USUAL_REGIONS, usual_place

ASSETS = Path(__file__).parents[1] / "data" / "assets"
SCENES = Path(__file__).parents[2] / "scenes"
ON_BODIES = {
    "glasses": "cat", "skateboard": "dog", "cape": "person", "wings": "cow", "crown": "bear", "pointed hat": "snowman",
    "backpack": "person", "antlers": "duck", "handle": "vase", "butterfly": "pig", "flower": "robot",
}  # fmt: skip


def _inside(points: np.ndarray, part: str, places: ObjectPlaces) -> float:
    (region,), _ = placed_regions(places, [usual_place(part)], None, part=part)
    to_unit = np.linalg.inv(region.to_world())
    return float((np.linalg.norm(points @ to_unit[:3, :3].T + to_unit[:3, 3], axis=1) < 1).mean())


@pytest.mark.parametrize("part", ON_BODIES)
def test_a_region_holds_most_of_such_a_part(part: str) -> None:
    """Parts of the coarse makers, whose sizes are not in the table."""
    body = BODIES[ON_BODIES[part]](np.random.default_rng(11))
    places = ObjectPlaces(body.solid.vertices, body.solid.faces)
    points = PARTS[part](body, np.random.default_rng(12)).vertices
    assert _inside(points, part, places) > 0.5  # antlers: their tips are in an ellipsoid's corners
    (region,), _ = placed_regions(places, [usual_place(part)], None, part=part)
    # And is no waste: twice the part's box at most, but for what is very thin.
    assert (2 * region.half_axes).max() < 2.2 * np.ptp(points, axis=0).max()


def test_all_parts_of_the_priors_have_one() -> None:
    vocabulary = read_model_conventions(WIDE_FOLDER).vocabulary
    assert vocabulary is not None and set(USUAL_REGIONS) == set(vocabulary.parts)
    assert set(vocabulary.bodies) > HEADLESS


@pytest.mark.parametrize("name", ["teapot", "car", "bottle", "tree", "mug"])
def test_what_has_no_head_gets_it_on_its_top(name: str, tmp_path: Path) -> None:
    """A teapot's spout was its head: the highest end of what is longer than high."""
    body = FINE_BODIES[name](np.random.default_rng(5))
    points = np.concatenate(
        [solid.vertices for solid in FINE_PARTS["candle"](Surface(body), np.random.default_rng(6)).values()]
    )
    trimesh.Trimesh(body.solid.vertices, body.solid.faces, process=False).export(tmp_path / "it.ply")
    made = fd.import_asset(tmp_path / "it.ply", tmp_path / "it", prompt=f"a {name} with a candle", up="y")
    assert any("puts the region at its top" in line for line in made.remarks)
    scene = fd.load_scene(made.scene)
    region, there = scene.regions[0], scene.frame.to_canonical(points)
    assert (region.sdf(there) > 0).mean() > 0.6 and region.size < 2.2 * np.ptp(there, axis=0).max()


def test_sizes_and_places_that_are_said_count() -> None:
    body = BODIES["bear"](np.random.default_rng(0))
    places = ObjectPlaces(body.solid.vertices, body.solid.faces)
    (said,), about = placed_regions(places, ["head"], "0.2", part="crown")
    assert np.allclose(2 * said.half_axes, 0.2 * places.longest_side) and "usual" not in about[0]
    (elsewhere,), _ = placed_regions(places, ["left side"], None, part="skateboard")
    assert np.allclose(2 * elsewhere.half_axes, 0.3 * places.longest_side)  # nothing is usual there
    (cape,), about = placed_regions(places, ["0,0.1,-2"], None, part="cape")
    assert cape.half_axes[0] > 1.2 * cape.half_axes[1] and "the usual size for cape" in about[0]  # there, and not below
    assert np.abs(cape.centre - places.find("0,0.1,-2").point).max() < 0.06 * places.longest_side
    (hat,), about = placed_regions(places, ["left side"], None, part="crown")
    assert hat.half_axes[0] > 1.5 * hat.half_axes[1] and "the usual size for crown" in about[0]
    (hole,), _ = placed_regions(places, ["head"], None, subtract=True, part="crown")
    assert hole.subtracts and np.allclose(2 * hole.half_axes, 0.3 * places.longest_side)


def test_a_mesh_needs_nothing_but_a_prompt(tmp_path: Path) -> None:
    made = fd.import_asset(ASSETS / "duck.stl", tmp_path / "duck", prompt="a duck on a skateboard")
    assert made.regions[0].startswith("bottom: ") and made.regions[0].endswith("the usual size for skateboard")
    assert any("puts the region at its bottom" in line for line in made.remarks)
    scene = fd.load_scene(made.scene)
    assert scene.regions[0].name == "bottom"
    off = fd.import_asset(ASSETS / "duck.stl", tmp_path / "off", prompt="a duck without a tail", subtract=True)
    assert off.regions[0].startswith("rear: ") and off.regions[0].endswith("subtracts")
    assert off.refusal is None
    plain = fd.import_asset(ASSETS / "duck.stl", tmp_path / "plain", prompt="a duck with a spaceship")
    assert plain.regions[0].startswith("head: ") and "usual" not in plain.regions[0]


def test_an_open_mesh_of_which_something_is_to_go_is_told_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not only by the run after it, in the same words, and then no run comes next."""
    mesh = trimesh.creation.box()
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(tmp_path / "box.obj")
    words = "a box without a horn"
    made = fd.import_asset(tmp_path / "box.obj", tmp_path / "scene", prompt=words, subtract=True)
    with pytest.raises(fd.UserError) as refused:
        fd.load_scene(made.scene)
    assert made.refusal == str(refused.value) and "is not closed (3 boundary edges)" in made.refusal
    again = tmp_path / "again"
    assert main(["import", str(tmp_path / "box.obj"), "--prompt", words, "--subtract", "-o", str(again)]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith(f"refused  a run refuses the scene as it is: {again}/scene.xml") and "not closed" in last
    grown = fd.import_asset(tmp_path / "box.obj", tmp_path / "grown", prompt="a box with a horn")
    assert grown.refusal is None


def test_a_scene_says_its_prompt_itself(capsys: pytest.CaptureFixture[str]) -> None:
    scene = SCENES / "cat" / "scene.xml"
    assert main(["check", str(scene), "--at", "head"]) == 0
    assert "the usual size for crown" in capsys.readouterr().err
    assert main(["check", str(scene), "--at", "head", "--prompt", "a cat with a butterfly"]) == 0
    assert "the usual size for butterfly" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("prompt", "part"),
    [
        ("a duck with a crown", "crown"),
        ("Sunglasses on a man", "glasses"),
        ("a horse with wings and a horn", None),
        ("a mug without a handle", None),
        ("a spaceship", None),
        ("", None),
        (None, None),
    ],
)
def test_the_one_part_of_a_prompt(prompt: str | None, part: str | None) -> None:
    assert prompted_parts(prompt).only == part


PAIR = "a duck with a shiny golden crown and a blue cape"


def test_several_parts_are_put_apart_each_with_its_own_words(tmp_path: Path) -> None:
    made = fd.import_asset(ASSETS / "duck.stl", tmp_path / "duck", prompt=PAIR)
    scene = fd.load_scene(made.scene)
    assert list(scene.parts) == ["crown", "cape"] and scene.base_prompt == "a duck"
    assert {part: own.prompt for part, own in scene.part_prompts.items()} == {
        "crown": "a duck with a shiny golden crown",
        "cape": "a duck with a blue cape",
    }
    assert scene.prompt_of("cape") == "a duck with a blue cape" and scene.prompt == PAIR
    alone = [
        fd.load_scene(fd.import_asset(ASSETS / "duck.stl", tmp_path / word, prompt=f"a duck with a {word}").scene)
        for word in ("crown", "cape")
    ]
    for region, other in zip(scene.regions, alone, strict=True):  # in a frame that has room for both
        to_user = scene.frame.matrix() @ np.linalg.inv(other.frame.matrix())
        assert np.allclose(region.to_canonical, to_user @ other.regions[0].to_canonical, atol=1e-5)


def test_several_parts_at_as_many_places_and_at_others() -> None:
    body = BODIES["bear"](np.random.default_rng(0))
    places = ObjectPlaces(body.solid.vertices, body.solid.faces)
    put, about = prompted_regions(places, prompted_parts(PAIR), ["left side", "head"], None, subtract=False)
    assert [region.name for region in put] == ["crown", "cape"] and about[0].startswith("crown at left_side: ")
    assert np.allclose(put[0].centre, placed_regions(places, ["left side"], None, part="crown")[0][0].centre)
    together, _ = prompted_regions(places, prompted_parts(PAIR), ["top"], None, subtract=False)
    assert [(region.name, region.part, region.prompt) for region in together] == [("top", None, None)]


def test_places_that_python_names_fit_the_prompt_too() -> None:
    scene = fd.load_scene(SCENES / "cat" / "scene.xml", prompt="a cat with wings", at=["back"])
    tail = fd.load_scene(SCENES / "cat" / "scene.xml", prompt="a cat with a tail", at=["back"])
    wide, round_ = (np.linalg.norm(s.regions[0].to_canonical[:3, :3], axis=0) for s in (scene, tail))
    assert wide.max() > 2.5 * wide.min() and np.ptp(round_) < 1e-6  # a tail is not usual there
    both = fd.load_scene(SCENES / "cat" / "scene.xml", prompt="a cat with wings and a crown", at=["back", "head"])
    assert list(both.parts) == ["wings", "crown"]


def test_what_a_base_has_already_and_what_is_not_wanted_get_no_region() -> None:
    assert prompted_parts("a cow with horns and a crown", "a cow with horns").only == "crown"
    asked = prompted_parts("a cow without horns and with a crown and wings")
    assert asked.body == "a cow" and list(asked.alone.values()) == ["a cow with a crown", "a cow with wings"]
    assert prompted_parts("put a crown on the cow").body == "a cow"
    assert prompted_parts("a man on a skateboard wearing a cape").alone["cape"] == "a person with a cape"
    long = prompted_parts("a duck with a very long, black crown and a cape").alone["crown"]
    assert "," not in long and read_prompt(long, vocabulary_of("builtin")).parts == ("crown",)


def test_two_parts_to_take_off_get_a_region_each() -> None:
    body = BODIES["cow"](np.random.default_rng(0))
    places = ObjectPlaces(body.solid.vertices, body.solid.faces)
    asked = prompted_parts("a cow without horns and a tail", removed=True)
    cut, about = prompted_regions(places, asked, [], None, subtract=True)
    assert [(one.name, one.prompt, one.subtracts) for one in cut] == [
        ("horns", "a cow without horns", True),
        ("tail", "a cow without a tail", True),
    ]
    assert np.allclose(cut[1].centre, placed_regions(places, ["rear"], None, subtract=True)[0][0].centre)
    assert all(line.endswith("subtracts") for line in about)


def test_a_place_may_be_one_word_in_python(tmp_path: Path) -> None:
    scene = fd.load_scene(SCENES / "cat" / "scene.xml", at="back")
    assert scene.regions[0].name == "back"
    made = fd.import_asset(ASSETS / "duck.stl", tmp_path / "duck", prompt=PAIR, at="head")
    assert made.regions[0].endswith("; crown, cape grow as one there: an --at for each puts them apart")


def test_misfits_of_prompt_and_regions_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = fd.import_asset(ASSETS / "duck.stl", tmp_path / "duck", prompt=PAIR).scene
    quick = RunConfig.load("quick")
    assert prompt_warnings(fd.load_scene(scene), quick) == []
    (other,) = prompt_warnings(fd.load_scene(scene, prompt="a duck with a top hat"), quick)
    assert "speaks of top hat" in other and "of cape, crown: say --at" in other
    cat = SCENES / "cat" / "scene.xml"
    (mixed,) = prompt_warnings(fd.load_scene(cat, prompt="a cat with wings and a crown"), quick)
    assert "crown, wings, and all regions are of one part" in mixed
    worn = replace(fd.load_scene(cat, prompt="a cat with wings and a crown"), base_prompt="a cat with a crown")
    assert prompt_warnings(worn, quick) == []
    hats = fd.load_scene(cat, prompt="a cat with a crown and a hat", at=["head", "head"])
    (shared,) = prompt_warnings(hats, quick)
    assert shared.startswith("parts crown and hat: their regions share a place")
    unguided = quick.model_copy(update={"geometry": quick.geometry.model_copy(update={"lambda_sds": 0.0})})
    assert prompt_warnings(hats, unguided) == []
    assert main(["check", str(scene), "--prompt", "a duck with a top hat"]) == 0
    assert "warning  the prompt speaks of top hat" in capsys.readouterr().out


def test_the_scene_of_a_run_is_not_replaced_by_a_refused_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = ["run", str(ASSETS / "duck.stl"), "-c", "smoke", "--stage", "geometry", "-q", "-o", str(tmp_path / "run")]
    assert main([*run, "--prompt", "a duck with a crown", "--set", "geometry.steps=1"]) == 0
    before = (tmp_path / "run.scene" / "scene.xml").read_bytes()
    assert main([*run, "--prompt", "a duck with wings", "--resume"]) != 0
    assert "holds a run already, of another import or another prompt" in capsys.readouterr().err
    assert (tmp_path / "run.scene" / "scene.xml").read_bytes() == before


def test_regions_of_a_file_are_not_told_beside_those_of_the_import(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own.xml"
    own.write_text(
        '<scene version="3.0.0"><integrator type="dual_path"><boolean name="only_these_regions" value="true"/>'
        '</integrator><shape type="focal_region" id="mine"><transform name="to_world"><scale value="12"/>'
        '<translate y="30"/></transform></shape></scene>'
    )
    main(["check", str(ASSETS / "duck.stl"), "--prompt", "a duck with a crown", "--regions", str(own)])
    said = capsys.readouterr()
    assert "imported" in said.err and "head" not in said.err
    assert "region   mine" in said.out and "usual size" not in said.err
