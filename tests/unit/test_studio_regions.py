"""Regions as the studio handles them: poses, mirror images, clicks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.focal_region import FocalRegion, PartPrompt
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose, quaternion, rotation_matrix, turned_to
from fd_mitsuba.studio.picking import first_hit
from fd_mitsuba.studio.region_list import NEW_RADIUS, RegionList

FRAME = Normalisation(np.array([1.0, 2.0, 3.0]), 0.5)
SIDE = EllipsoidPose("wing", (1.8, 2.5, 3.2), tuple(Rotation.from_euler("xyz", [20, 30, 40], True).as_quat()[[3, 0, 1, 2]]), (0.2, 0.5, 0.1))  # fmt: skip  # noqa: E501
CENTRED = EllipsoidPose("crest", (1.0, 3.0, 3.0), (1.0, 0.0, 0.0, 0.0), (0.2, 0.3, 0.4))


def region_list(*poses: EllipsoidPose) -> RegionList:
    return RegionList(FRAME, {pose.name: pose for pose in poses})


@pytest.mark.parametrize("seed", range(8))
def test_rotations_agree_with_scipy(seed: int) -> None:
    turn = Rotation.random(random_state=seed)
    found = quaternion(turn.as_matrix())
    assert Rotation.from_quat(np.array(found)[[1, 2, 3, 0]]).as_matrix() == pytest.approx(turn.as_matrix(), abs=1e-12)
    assert rotation_matrix(found) == pytest.approx(turn.as_matrix(), abs=1e-12)


@pytest.mark.parametrize("sheared", [False, True])
def test_pose_is_the_same_set_of_points(sheared: bool) -> None:
    random = np.random.default_rng(3)
    matrix = np.eye(4)
    matrix[:3, :3] = random.normal(size=(3, 3)) if sheared else SIDE.rotation * [-0.3, 0.2, 0.9]
    matrix[:3, 3] = random.normal(size=3)
    pose = EllipsoidPose.of_matrix("r", matrix)
    points = np.random.default_rng(4).normal(size=(500, 3))
    expected = FocalRegion("r", matrix).sdf(points)
    assert FocalRegion("r", pose.matrix).sdf(points) == pytest.approx(expected, abs=1e-5)
    assert min(pose.radii) > 0 and np.linalg.det(pose.rotation) == pytest.approx(1)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_mirror_image_is_the_reflected_set(axis: int) -> None:
    image = SIDE.mirrored("other", axis, 0.7)
    points = np.random.default_rng(5).normal(size=(500, 3)) + SIDE.centre
    reflected = points.copy()
    reflected[:, axis] = 1.4 - reflected[:, axis]
    expected = FocalRegion("r", SIDE.matrix).sdf(points)
    assert FocalRegion("r", image.matrix).sdf(reflected) == pytest.approx(expected, abs=1e-6)


def test_a_centred_region_has_no_mirror_image_of_its_own() -> None:
    regions = region_list(SIDE, CENTRED)
    with pytest.raises(UserError, match="crest: lies on the base's middle"):
        regions.mirror("crest", 0)
    image = regions.mirror("wing", 0)
    assert image.centre[0] == pytest.approx(0.2) and list(regions.poses) == ["wing", "crest", "wing_mirrored"]
    with pytest.raises(UserError, match="wing: has its mirror image already"):
        regions.mirror("wing", 0)
    assert regions.mirror("crest", 1).centre == pytest.approx((1.0, 1.0, 3.0))


def test_click_finds_the_nearest_face() -> None:
    vertices, faces = unit_sphere(4)
    ball = TriangleMesh("ball", vertices, faces)
    direction = np.array([-0.3, -0.2, -1.0])
    origin = np.array([0.4, 0.3, 3.0])
    hit = first_hit(ball, origin, direction)
    # |o + t d| = 1, the smaller root
    a, b, c = direction @ direction, origin @ direction, origin @ origin - 1
    exact = origin + (-b - np.sqrt(b * b - a * c)) / a * direction
    assert hit is not None and hit.point == pytest.approx(exact, abs=5e-3)
    assert hit.normal @ exact > 0.99
    assert first_hit(ball, origin, -direction) is None


def test_new_region_reaches_into_the_base_and_stands_upright_on_it() -> None:
    regions = region_list(CENTRED)
    normal = np.array([0.6, 0.0, 0.8])
    pose = regions.add(np.array([0.1, 0.2, 0.3]), normal)
    to_surface = FRAME.to_canonical(np.array(pose.centre)) - [0.1, 0.2, 0.3]
    assert np.linalg.norm(to_surface) == pytest.approx(0.75 * NEW_RADIUS)
    assert pose.rotation @ [0, 1, 0] == pytest.approx(normal)
    assert turned_to(np.array([0.0, -1.0, 0.0])) == (0.0, 1.0, 0.0, 0.0)


def test_what_cannot_be_is_refused() -> None:
    regions = region_list(CENTRED)
    for bad in ("base", "a/b", "", "x" * 65):
        with pytest.raises(UserError, match="cannot name a file"):
            regions.put(EllipsoidPose("crest", CENTRED.centre, CENTRED.wxyz, CENTRED.radii, bad))
    with pytest.raises(UserError, match="is not there"):
        regions.remove("wing")
    with pytest.raises(ValueError):
        CENTRED.moved((0.0, float("nan"), 0.0))


def test_a_prompt_is_that_of_a_part() -> None:
    regions = region_list(SIDE, replace(CENTRED, part="hat", prompt="a hat"))
    image = regions.mirror("wing", 1)
    regions.put(replace(image, prompt="wings"))
    regions.put(replace(SIDE, prompt="bat wings"))  # each region of the part that says something says the same
    assert [pose.prompt for pose in regions.poses.values()] == ["bat wings", "a hat", "bat wings"]
    found = {region.name: region.prompt for region in regions.focal_regions()}
    assert found["crest"] == PartPrompt("a hat") and found["wing"] == found[image.name] == PartPrompt("bat wings")
    regions.remove("wing")
    regions.put(replace(regions.poses[image.name], part="hat"))  # now of a part that has its words
    assert regions.poses[image.name].prompt == "a hat"
    regions.put(replace(regions.poses["crest"], prompt=""))
    assert not any(pose.prompt for pose in regions.poses.values())
    with pytest.raises(UserError, match="1001 characters"):
        regions.put(replace(regions.poses["crest"], prompt="x" * 1001))
    vertices, faces = unit_sphere(1)
    ball = FocalRegion("ball", np.eye(4), "hat", TriangleMesh("ball", vertices, faces), prompt=PartPrompt("a cap"))
    regions.meshes["ball"] = ball
    with pytest.raises(UserError, match="ball, a mesh of the same part, has the prompt 'a cap'"):
        regions.put(replace(regions.poses["crest"], prompt="a crown"))


def test_words_stay_with_the_part_whose_region_goes() -> None:
    regions = region_list(replace(SIDE, prompt="wings", negative_prompt="feathers"))
    image = regions.mirror("wing", 0)
    regions.poses[image.name] = replace(image, prompt="", negative_prompt="")
    regions.remove("wing")
    assert regions.focal_regions()[0].prompt == PartPrompt("wings", "feathers")


def test_record_round_trip() -> None:
    assert EllipsoidPose.of_json(SIDE.to_json()) == EllipsoidPose.of_json(
        EllipsoidPose.of_json(SIDE.to_json()).to_json()
    )
    other = region_list(CENTRED)
    other.restore([SIDE.to_json()], [])
    assert list(other.poses) == ["wing"] and other.poses["wing"].lies_on(SIDE)
    with pytest.raises(ValueError):
        other.restore([SIDE.to_json(), SIDE.to_json()], [])
