"""Places by words, on shapes whose places are known, on the shipped scenes, and through the commands."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import fd_mitsuba as fd
from fd_mitsuba.cli.main import main
from fd_mitsuba.errors import UserError
from fd_mitsuba.prior.data.fine.bodies import BODIES
from fd_mitsuba.prior.data.primitives import lathe
from fd_mitsuba.scene.load_scene import load_base, load_edit_scene
from fd_mitsuba.scene.region_size import region_size
from fd_mitsuba.scene.region_words import ObjectPlaces
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.viewing.preview import preview_scene

SCENES = Path(__file__).parents[2] / "scenes"
ASSETS = Path(__file__).parents[1] / "data" / "assets"
Make = Callable[..., Path]


@pytest.fixture(scope="module")
def beast() -> ObjectPlaces:
    """A long body, a head in front of it and higher, a tail tip behind; looks along +z."""
    vertices, faces = unit_sphere(3)
    pieces = [([0.3, 0.3, 1.0], [0, 1, 0]), ([0.25, 0.25, 0.25], [0, 1.5, 1]), ([0.05, 0.05, 0.2], [0, 1.1, -1.1])]
    points = [vertices * radii + centre for radii, centre in pieces]
    return ObjectPlaces(
        np.concatenate(points), np.concatenate([faces + number * len(vertices) for number in range(len(pieces))])
    )


@pytest.mark.parametrize(
    ("words", "point", "normal"),
    [
        ("head", (0, 1.75, 1), (0, 1, 0)),
        ("top", (0, 1.75, 1), (0, 1, 0)),
        ("the back", (0, 1.3, 0), (0, 1, 0)),
        ("front of the head", (0, 1.62, 1.22), (0, 0, 1)),
        ("Left side of head", (0.22, 1.62, 1), (1, 0, 0)),
        ("left side", (0.3, 1, 0), (1, 0, 0)),
        ("right", (-0.3, 1, 0), (-1, 0, 0)),
        ("bottom", (0, 0.7, 0), (0, -1, 0)),
        ("0, 1.9, 1", (0, 1.75, 1), (0, 1, 0)),
    ],
)
def test_words_find_the_place(beast: ObjectPlaces, words: str, point: tuple, normal: tuple) -> None:
    place = beast.find(words)
    assert np.allclose(place.point, point, atol=0.1) and np.allclose(place.normal, normal, atol=0.1)
    # It is a point of the surface: one of the three ellipsoids, whose faces lie a little within.
    region = beast.region(place, 0.4)
    outwards = 0.0 if words == "front of the head" else 0.7  # what is worn on a face goes round it
    assert np.allclose(region.centre - place.point, outwards * 0.2 * place.normal) and not region.subtracts
    cut = beast.region(place, 0.4, subtracts=True)
    assert np.allclose(cut.centre - place.point, -0.7 * 0.2 * place.normal) and cut.subtracts


@pytest.mark.parametrize("name", ["horse", "deer", "dog", "cat", "cow", "duck", "dragon"])
def test_heads_and_eyes_are_where_the_makers_of_bodies_say(name: str) -> None:
    """Bodies of closed pieces that overlap: what lies inside of another piece is no surface."""
    body = BODIES[name](np.random.default_rng(1))
    places = ObjectPlaces(body.solid.vertices, body.solid.faces)
    assert np.linalg.norm(places.find("head").point - body.head_top) < 0.04 * places.longest_side
    face = places.find("front of the head").point
    assert abs(face[1] - body.eyes()[0, 1]) < 0.02 * places.longest_side
    assert body.head_top[2] < face[2] < body.eyes()[0, 2] + 0.1 * places.longest_side


def test_the_top_of_an_open_vessel_is_at_its_rim() -> None:
    cup = lathe([(0.9, 0.0), (1.0, 0.1), (1.0, 2.0), (0.9, 2.0), (0.9, 0.2), (0.1, 0.2)])
    places = ObjectPlaces(cup.vertices, cup.faces)
    for word in ("top", "head"):
        assert np.allclose(places.find(word).point, [0, 2, 0], atol=0.1)


def test_faces_may_look_inwards() -> None:
    body = BODIES["horse"](np.random.default_rng(1)).solid
    heads = [ObjectPlaces(body.vertices, faces).find("head").point for faces in (body.faces, body.faces[:, ::-1])]
    assert np.allclose(*heads, atol=0.03)


def test_front_and_rear_are_the_ends(beast: ObjectPlaces) -> None:
    assert beast.find("front").point[2] > 0.9 and beast.find("rear").point[2] < -0.9


@pytest.mark.parametrize(
    ("name", "height"),
    # Read off the previews, by eye, as shares of the height: the eyes of rabbit, cat and person.
    [("rabbit_glasses", 0.59), ("cat", 0.77), ("superhero", 0.89)],
)
def test_the_front_of_a_head_is_between_the_eyes(name: str, height: float) -> None:
    mesh = load_edit_scene(SCENES / name / "scene.xml").base_soup
    places = ObjectPlaces(mesh.vertices, mesh.faces)
    place = places.find("front of the head")
    size = places.high - places.low
    assert abs((place.point - places.low)[1] / size[1] - height) < 0.05
    assert abs((place.point - places.low)[0] / size[0] - 0.5) < 0.03
    left, right = (places.find(f"{side} side of the head").point for side in ("left", "right"))
    assert right[0] < place.point[0] < left[0] and abs(left[1] - place.point[1]) < 0.05 * size[1]
    assert places.find("front of the head").name == "front_of_head"
    assert places.find("left side of head").name == "left_side_of_head"
    assert np.allclose(places.find("top of the head").point, places.find("head").point)


@pytest.mark.parametrize("name", ["pegasus", "unicorn", "skateboard_dog", "wooden_horse", "cat"])
def test_the_back_of_an_animal_is_not_its_neck(name: str) -> None:
    """Heads begin above .75 of the height, and necks reach back into the middle two fifths of the length."""
    mesh = load_edit_scene(SCENES / name / "scene.xml").base_soup
    places = ObjectPlaces(mesh.vertices, mesh.faces)
    share = (places.find("back").point - places.low) / (places.high - places.low)
    assert abs(share[2] - 0.5) < 0.06 and abs(share[0] - 0.5) < 0.06 and 0.55 < share[1] < 0.75, share


@pytest.mark.parametrize("name", ["superhero", "skateboard_dog", "mug"])
def test_the_bottom_is_where_it_stands_and_the_belly_above(name: str) -> None:
    mesh = load_edit_scene(SCENES / name / "scene.xml").base_soup
    places = ObjectPlaces(mesh.vertices, mesh.faces)
    size = places.high - places.low
    bottom, belly = (places.find(word).point for word in ("underside", "belly"))
    assert bottom[1] == places.low[1] and (np.abs(bottom - places.low - size / 2)[[0, 2]] < 0.25 * size[[0, 2]]).all()
    assert belly[1] >= bottom[1] and (belly[1] > bottom[1] + 0.2 * size[1]) == (name != "mug")


def test_the_top_of_a_head_is_below_its_ears() -> None:
    """An ear that leans back, in the middle as a comb, so that from above it is met first."""
    vertices, faces = unit_sphere(3)
    tilt = np.radians(25)
    lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    ear = (vertices * [0.05, 0.35, 0.09]) @ lean + np.array([0, 1.95, -0.05])
    pieces = [vertices * [0.4, 0.6, 0.4] + [0, 0.6, 0], vertices * 0.3 + [0, 1.4, 0.1], ear]
    rabbit = ObjectPlaces(np.concatenate(pieces), np.concatenate([faces + k * len(vertices) for k in range(3)]))
    assert ear[:, 1].max() > 2.2
    head = rabbit.find("head").point
    assert 1.6 < head[1] < 1.85 and abs(head[0]) < 0.02 and -0.1 < head[2] < 0.2
    assert 1.2 < rabbit.find("front of the head").point[1] < 1.6


def test_arms_and_pots_have_no_eyes() -> None:
    """A figure without a neck, its arms out: its face is above them; of a column the face is high up."""
    vertices, faces = unit_sphere(3)
    pieces = [([0.2, 1.0, 0.2], [0, 1, 0]), ([0.9, 0.1, 0.1], [0, 1.3, 0])]
    points = np.concatenate([vertices * radii + centre for radii, centre in pieces])
    figure = ObjectPlaces(points, np.concatenate([faces, faces + len(vertices)]))
    assert 1.4 < figure.find("front of the head").point[1] < 1.95
    column = ObjectPlaces(vertices * [0.3, 1.0, 0.3] + [0, 1, 0], faces)
    assert 1.4 < column.find("front of the head").point[1] < 1.95


@pytest.mark.parametrize("words", ["head", "front of the head", "left side of the head", "back", "belly", "bottom"])
def test_plates_and_objects_in_two_halves_have_places(words: str) -> None:
    corners = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    halves = np.concatenate([corners * 0.1 + [0, 0, 2], corners * 0.1 - [0, 0, 2]])
    for places in (ObjectPlaces(corners, faces), ObjectPlaces(halves, np.concatenate([faces, faces + 4]))):
        place = places.find(words)
        assert np.isfinite(place.point).all() and np.isclose(np.linalg.norm(place.normal), 1)


def test_the_back_of_what_stands_upright_is_behind() -> None:
    vertices, faces = unit_sphere(3)
    upright = ObjectPlaces(vertices * [0.5, 1, 0.4], faces)
    assert np.allclose(upright.find("back").point, [0, 0, -0.4], atol=0.02)
    assert np.allclose(upright.find("head").point, [0, 1, 0], atol=0.02)


@pytest.mark.parametrize("words", ["knee", "front of the knee", "1,2", "1,2,nan", "1,2,x", ""])
def test_unknown_places_are_refused(beast: ObjectPlaces, words: str) -> None:
    with pytest.raises(UserError, match="--at"):
        beast.find(words)


def test_sizes() -> None:
    assert region_size(None, 10) == (3.0, 3.0, 3.0) and region_size("30%", 10) == (3.0, 3.0, 3.0)
    assert region_size("0.2", 10) == (2.0, 2.0, 2.0) and region_size("5u", 10) == (5.0, 5.0, 5.0)
    assert region_size("0.2,50%,1u", 10) == (2.0, 5.0, 1.0)
    for wrong in ("", "0", "3", "x", "1,2", "0.1u", "-1", "5cm"):
        with pytest.raises(UserError, match="--size"):
            region_size(wrong, 10)


@pytest.mark.parametrize(
    ("name", "words", "region"),
    [
        ("cat", "head", "head_top"),
        ("unicorn", "head", "horn"),
        ("snowman", "head", "hat"),
        ("teddy_backpack", "back", "backpack"),
        ("superhero", "back", None),
    ],
)
def test_places_are_where_the_shipped_scenes_have_their_regions(name: str, words: str, region: str | None) -> None:
    scene = load_edit_scene(SCENES / name / "scene.xml")
    (mesh,) = [scene.base_soup]
    place = ObjectPlaces(mesh.vertices, mesh.faces).find(words)
    centre = scene.frame.to_canonical(place.point)
    nearest = min(np.linalg.norm(other.centre - centre) for other in scene.regions)
    assert nearest < 0.45, (nearest, [other.name for other in scene.regions])  # of a longest side of 1.8


def test_at_takes_the_place_of_the_scenes_own_regions(make_scene: Make) -> None:
    path = make_scene()
    scene = fd.load_scene(path, at=["head", "left side", "head"], size="20%")
    assert [region.name for region in scene.regions] == ["head_1", "left_side", "head_3"]
    assert scene.prompt == "a pig with two wings" and scene.base_prompt == "a pig"
    longest = np.ptp(scene.base_soup.vertices, axis=0).max()
    assert np.isclose(scene.regions[0].size / scene.frame.scale, 0.2 * longest, rtol=1e-4)
    again = load_edit_scene(path, regions=scene.regions_path)  # as a run is opened later
    assert np.allclose(again.regions[1].to_canonical, scene.regions[1].to_canonical)
    assert [region.name for region in load_edit_scene(path).regions] == ["wing"]
    low, high = (load_base(path)[0].vertices.min(axis=0), load_base(path)[0].vertices.max(axis=0))
    left = scene.frame.to_user(scene.regions[1].centre)
    assert left[0] > 0 and (low[1:] < left[1:]).all() and (left[1:] < high[1:]).all()


def test_a_pixel_of_a_preview_is_a_place(make_scene: Make, tmp_path: Path) -> None:
    path = make_scene(region="", integrator="")
    bare = load_edit_scene(path, needs_region=False)  # without region or prompt
    (sheet,) = preview_scene(bare, tmp_path / "out", ["left", "top"], 64)
    with Image.open(sheet) as image:
        views = json.loads(image.info["fd_mitsuba"])["views"]
    places = ObjectPlaces(bare.base_soup.vertices, bare.base_soup.faces)
    low, high = bare.base_box
    for view, axis in zip(views, (0, 1), strict=True):
        middle = (view["left"] + view["size"] // 2, view["top"] + view["size"] // 2)
        place = places.find(f"pixel {middle[0]} {middle[1]} of {sheet}")
        along = [i for i in range(3) if i != axis]
        pixel = 2 * view["half"] / view["size"]
        assert np.abs(place.point[along] - ((low + high) / 2)[along]).max() <= pixel  # under the picture's middle
        assert place.point[axis] > ((low + high) / 2)[axis]  # on the side that is seen
        assert place.normal[axis] > 0.5
    for text in (f"pixel 0 0 of {sheet}", "pixel 3 3 of none.png", f"pixel 3 3 of {path}"):
        with pytest.raises(UserError, match=r"beside its views|not found|no preview"):
            places.find(text)
    corner = f"pixel {views[0]['left'] + 1} {views[0]['top'] + 1} of {sheet}"
    with pytest.raises(UserError, match="nothing of the object is seen"):
        places.find(corner)


def test_commands_take_places_and_assets(make_scene: Make, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene = str(make_scene())
    assert main(["check", scene, "--at", "head", "-c", "smoke"]) == 0
    out, err = capfd.readouterr()
    assert "region   head (part part)" in out and "region   wing" not in out and "in place of the scene's own" in err
    box = str(ASSETS / "box.glb")
    assert main(["check", box, "--prompt", "a box with a hat", "--at", "top", "--set", "geometry.lambda_sds=0"]) == 0
    out, err = capfd.readouterr()
    assert "prompt   a box with a hat" in out and "region   top" in out and err.count("\n") == 1
    assert main(["check", scene, "--at", "-0.5,0.5,0", "--at", "-.5,.2,-1", "-c", "smoke"]) == 0  # no option is meant
    assert capfd.readouterr().out.count("region   point") == 2
    assert main(["check", box, "--prompt", "a box with a hat", "--at", "top", "--up", "z", "--front", "-x"]) == 0
    assert "takes" not in capfd.readouterr().err
    off = ["--subtract", "--prompt", "a box without a hat"]
    for asked in ([scene, "--at", "head"], [box, "--at", "top"]):
        assert main(["check", *asked, *off]) == 0
        out, err = capfd.readouterr()
        assert "read as  taken off: hat; body: " in out and "subtracts" in err
    for arguments, words in (
        ([scene, "--up", "z"], "--up: is for mesh files"),
        ([scene, "--size", "0.3"], "--size"),
        ([scene, "--subtract"], "--subtract: is for the regions of --at"),
        ([scene, "--at", "knee"], "--at knee"),
        ([scene, "--at", "-1,2"], "--at -1,2"),
        ([scene, "--at", "head", "--regions", scene], "give one of the two"),
        ([box, "--at", "head", "--regions", scene], "give one of the two"),
        ([str(tmp_path / "none.glb")], "not found"),
    ):
        assert main(["check", *arguments]) == 1
        line = capfd.readouterr().err
        assert words in line and line.count("\n") == 1, line
