"""Writing regions and prompt into a scene file leaves the rest of its bytes alone, and Mitsuba reads what was meant."""

from __future__ import annotations

import difflib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose, turned_to
from fd_mitsuba.studio.region_list import RegionList
from fd_mitsuba.studio.scene_patch import patched, region_spans
from fd_mitsuba.studio.xml_spans import spans_of

HAT = EllipsoidPose("hat", (0.0, 1.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.3, 0.4, 0.3))
TEXT = b"""<?xml version="1.0"?>
<!-- before --> <scene version="3.0.0">
  <default name="words" value="a cat"/>  <!-- kept: > " -->
  <integrator type="dual_path"><string name="prompt" value="$words"/></integrator>

  <shape type="focal_region" id="hat">
    <!-- where the hat goes -->
    <transform name="to_world">
      <scale x="0.3" y="0.4" z="0.3"/> <translate y="1"/>
    </transform>
  </shape>
  <shape type="sphere" id="base"/>\t<!-- last -->
</scene>
"""


def changed_lines(before: bytes, after: bytes) -> list[str]:
    lines = difflib.ndiff(before.decode().splitlines(), after.decode().splitlines())
    return [line for line in lines if line[0] in "+-"]


def test_nothing_changed_is_the_same_bytes() -> None:
    assert patched(TEXT, "s.xml", [HAT], [HAT], prompt="a cat") == TEXT


def test_a_moved_region_changes_its_transform_alone() -> None:
    moved = replace(HAT, centre=(0.5, 1.0, 0.0))
    assert changed_lines(TEXT, patched(TEXT, "s.xml", [moved], [HAT])) == [
        '-       <scale x="0.3" y="0.4" z="0.3"/> <translate y="1"/>',
        '+       <scale x="0.3" y="0.4" z="0.3"/>',
        '+       <translate x="0.5" y="1" z="0"/>',
    ]


def test_the_prompt_of_a_part_is_written_into_its_regions() -> None:
    told = replace(HAT, prompt='a "red" hat', negative_prompt="a cap")
    after = patched(TEXT, "s.xml", [told], [HAT])
    assert changed_lines(TEXT, after) == [
        '+     <string name="negative_prompt" value="a cap"/>',
        '+     <string name="prompt" value=\'a "red" hat\'/>',
    ]
    other = patched(after, "s.xml", [replace(told, prompt="a hat")], [told])
    assert changed_lines(after, other)[-1] == '+     <string name="prompt" value="a hat"/>'
    assert patched(other, "s.xml", [HAT], [replace(told, prompt="a hat")]) == TEXT
    new = patched(TEXT, "s.xml", [HAT, replace(told, name="horn", part="horn")], [HAT])
    assert b'<string name="part" value="horn"/>\n    <string name="prompt" value=' in new


def test_prompt_goes_where_it_came_from() -> None:
    after = patched(TEXT, "s.xml", [HAT], [HAT], prompt='a "cat" & $5')
    assert changed_lines(TEXT, after) == [
        '-   <default name="words" value="a cat"/>  <!-- kept: > " -->',
        '+   <default name="words" value=\'a "cat" &amp; \\$5\'/>  <!-- kept: > " -->',
    ]
    plain = TEXT.replace(b"$words", b"a dog")
    assert b'<string name="prompt" value="a cat with a hat"/>' in patched(
        plain, "s.xml", [HAT], [HAT], prompt="a cat with a hat"
    )


def test_prompt_of_a_scene_without_one() -> None:
    line = b'  <integrator type="dual_path"><string name="prompt" value="$words"/></integrator>\n'
    path = TEXT.replace(line, b'  <integrator type="path"/>\n')
    after = patched(path, "s.xml", [HAT], [HAT], prompt="a dog", base_prompt="a wolf")
    assert b'<integrator type="path"' not in after and after.count(b"<integrator") == 1
    assert b'value="a wolf"' in after
    assert b'value="a dog"' in patched(TEXT.replace(line, b""), "s.xml", [HAT], [HAT], prompt="a dog")


def test_regions_come_and_go_in_place() -> None:
    wing = EllipsoidPose("wing", (1, 2, 3), turned_to(np.array([1.0, 0.0, 0.0])), (0.1, 0.2, 0.3), "wings")
    both = patched(TEXT, "s.xml", [HAT, wing], [HAT])
    assert list(region_spans(spans_of(both, ""))) == ["hat", "wing"] and both.index(b"wing") < both.index(b"sphere")
    assert not [line for line in changed_lines(TEXT, both) if line[0] == "-"]
    assert patched(both, "s.xml", [HAT], [HAT, wing]) == TEXT
    swapped = patched(TEXT, "s.xml", [wing], [HAT])
    assert list(region_spans(spans_of(swapped, ""))) == ["wing"] and b"<!-- last -->" in swapped


def test_what_stands_elsewhere_is_refused() -> None:
    with pytest.raises(UserError, match="region tail does not stand in this file"):
        patched(TEXT, "s.xml", [HAT], [HAT, replace(HAT, name="tail")])
    with pytest.raises(UserError, match="not UTF-8"):
        patched(b'<?xml version="1.0" encoding="latin-1"?><scene/>', "s.xml", [], [])
    with pytest.raises(UserError, match="s.xml:2: not well-formed"):
        patched(b"<scene>\n<a></scene>", "s.xml", [], [])


@pytest.mark.parametrize("scene", ["snowman", "superhero"])
def test_shipped_scenes_are_read_back_as_meant(scene: str, tmp_path: Path) -> None:
    source = Path(__file__).parents[2] / "scenes" / scene
    before = load_edit_scene(source / "scene.xml")
    regions = RegionList.of_scene(before)
    data = (source / "scene.xml").read_bytes()
    poses = list(regions.poses.values())
    assert patched(data, "s", poses, poses, list(regions.meshes), before.prompt) == data
    if not poses:
        return
    turned = poses[0].moved(np.array(poses[0].centre) * 1.01, turned_to(np.array([0.6, 0.48, 0.64])))
    (tmp_path / scene).mkdir()
    for path in source.parent.joinpath(scene).iterdir():
        (tmp_path / scene / path.name).symlink_to(path)
    (tmp_path / "lighting").symlink_to(source.parent / "lighting")
    new = tmp_path / scene / "new.xml"
    new.write_bytes(patched(data, "s", [turned, *poses[1:]], poses, list(regions.meshes)))
    after = load_edit_scene(new, on_misplaced=lambda error: None)
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    expected = FocalRegion("r", after.frame.matrix() @ turned.matrix).sdf(points)
    assert after.regions[0].sdf(points) == pytest.approx(expected, abs=1e-5)
    assert [r.to_canonical.tolist() for r in after.regions[1:]] == [r.to_canonical.tolist() for r in before.regions[1:]]
