"""The studio without a browser: what a person does, what is kept, what is refused."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fd_mitsuba.api import import_asset
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.studio import checks as checking
from fd_mitsuba.studio.history import History
from fd_mitsuba.studio.job import RunOrder
from fd_mitsuba.studio.live_check import LiveCheck
from fd_mitsuba.studio.opening import open_target
from fd_mitsuba.studio.plain_text import without_paths
from fd_mitsuba.studio.region_list import RegionList
from fd_mitsuba.studio.run_state import QUEUED
from fd_mitsuba.studio.session import Session
from fd_mitsuba.studio.settings import StudioSettings

ASSETS = Path(__file__).parents[1] / "data" / "assets"
NOTHING = (sys.executable, "-I", "-c", "")
SMOKE = StudioSettings("smoke")


def opened(target: Path, work: Path, **parameters: str) -> Session:
    found = open_target(target, work, parameters, say=lambda line: None)
    return Session(found, SMOKE, program=NOTHING, say=lambda line: None)


@pytest.fixture
def checks() -> None:
    """Wanted by tests of what the check says; all others are spared its time."""


@pytest.fixture(autouse=True)
def no_check(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "checks" not in request.fixturenames:
        monkeypatch.setattr(checking, "live_check", lambda scene, config: LiveCheck())


@pytest.fixture
def scene(make_scene, mi) -> Path:
    return make_scene(extra="<!-- mine -->")


@pytest.fixture
def session(scene: Path, tmp_path: Path):
    made = opened(scene, tmp_path / "work")
    yield made
    made.close()


def test_what_a_person_does_is_heard_and_kept(session: Session, scene: Path, tmp_path: Path) -> None:
    topics: list[str] = []
    session.subscribe(topics.append)
    before = session.state.regions.poses["wing"]
    session.edits.put(replace(before, centre=(0.2, 0.3, 0.0)))
    session.edits.put(session.state.regions.poses["wing"])  # what a field echoes is no change
    image = session.edits.mirror("wing")
    session.edits.set_prompt("  a pig with \n a hat ")
    session.edits.set_prompt("a pig with a hat")
    session.edits.set_settings(seed=3, steps=7)
    assert topics == ["pose", "regions", "prompt", "settings"]
    assert session.state.selected == image == "wing_mirrored"
    assert session.state.settings.config().geometry.steps == 7 and session.state.settings.config().seed == 3
    session.save()
    again = opened(scene, tmp_path / "work")
    assert again.state.regions.poses == session.state.regions.poses and again.state.prompt == "a pig with a hat"
    assert (again.state.settings, again.state.selected) == (session.state.settings, image)
    again.close()


@pytest.mark.parametrize("name", ["duck.stl", "box.glb"])
def test_an_untouched_region_of_an_opened_mesh_follows_the_prompt(session: Session, name: str) -> None:
    session.open_mesh(ASSETS / name)
    (on_head,) = session.state.regions.poses.values()
    topics: list[str] = []
    session.subscribe(topics.append)
    session.edits.set_prompt("a duck on a skateboard")
    (below,) = session.state.regions.poses.values()
    assert topics == ["regions", "prompt"] and below.centre[1] < on_head.centre[1]
    assert max(below.radii) > 2 * min(below.radii)
    session.edits.set_prompt("a duck with a spaceship")
    (back,) = session.state.regions.poses.values()
    assert back.lies_on(on_head)
    session.edits.undo()  # what was typed without a break is one change
    assert list(session.state.regions.poses.values()) == [on_head]
    x, y, z = on_head.radii
    session.edits.put(replace(on_head, radii=(1.1 * x, y, z)))
    (mine,) = session.state.regions.poses.values()
    session.edits.set_prompt("a duck with a crown")  # a region that was touched stays
    assert list(session.state.regions.poses.values()) == [mine]


def test_each_part_of_a_prompt_gets_a_region_as_an_import_puts_it(session: Session, tmp_path: Path) -> None:
    session.open_mesh(ASSETS / "duck.stl")
    (on_head,) = session.state.regions.poses.values()
    prompt = "a duck with a golden crown and a red cape"
    session.edits.set_prompt(prompt)
    imported = load_edit_scene(import_asset(ASSETS / "duck.stl", tmp_path / "duck", prompt=prompt).scene)
    found = session.state.regions
    assert list(found.poses) == ["crown", "cape"] and session.state.selected == "crown"
    for pose, other in zip(found.poses.values(), RegionList.of_scene(imported).poses.values(), strict=True):
        assert pose.lies_on(other) and (pose.part, pose.prompt) == (other.part, other.prompt)
    assert session.state.edited_scene().told_apart
    session.edits.set_prompt("a duck with a silver crown and a red cape")
    assert found.poses["crown"].prompt == "a duck with a silver crown"
    session.edits.set_prompt("a duck with a spaceship")
    (back,) = session.state.regions.poses.values()
    assert back.lies_on(on_head) and (back.name, back.part, back.prompt) == ("head", "part", "")
    assert session.state.selected == "head"
    session.edits.set_prompt(prompt)
    session.edits.put(replace(found.poses["cape"], prompt="a duck with a long cape"))
    mine = list(session.state.regions.poses.values())
    session.edits.set_prompt("a duck with a crown")  # a prompt that was touched stays, and so do all regions
    assert list(session.state.regions.poses.values()) == mine


def test_a_click_puts_a_region_on_the_base(session: Session) -> None:
    name = session.edits.add_at([0.0, 3.0, 0.0], [0.0, -1.0, 0.0])
    assert name == "region" and session.state.selected == name
    pose = session.state.regions.poses[name]
    top = session.state.scene.base_canonical.vertices[:, 1].max()
    height = session.state.scene.frame.to_canonical(np.array(pose.centre))[1]
    assert height < top + 0.25 and pose.part == "part"
    assert session.edits.add_at([0.0, 3.0, 0.0], [0.0, 1.0, 0.0]) is None
    assert session.edits.add() == "region_2"


def test_check_reads_the_prompt_and_refuses(session: Session, checks: None) -> None:
    session.edits.set_prompt("a pig with wings")
    fine = session.checks.now()
    assert fine.refusal is None and "wing" in fine.told
    assert re.search(r"\d (s|min) for the shape", fine.estimate)  # slower on a busy machine
    assert fine.regions[0].startswith("wing: touches the base, 100% in the grid") and "of room above" in fine.regions[0]
    session.edits.set_prompt("a pig with a submarine")
    with pytest.raises(UserError, match="the built-in prior knows no"):
        session.grow()
    session.edits.set_prompt(" ")
    assert "prompt is blank" in str(session.checks.now().refusal)
    with pytest.raises(UserError, match="prompt is blank"):
        session.save_scene()
    session.edits.set_prompt("a pig with wings")
    wing = session.state.regions.poses["wing"]
    session.edits.put(replace(wing, centre=(0.0, 0.6, 0.0)))
    assert "100% in the grid" in session.checks.now().regions[0]  # the grid makes room
    session.edits.put(replace(wing, centre=(0.0, 40.0, 0.0)))
    assert "lies in the editable cube" in str(session.checks.now().refusal)
    with pytest.raises(UserError, match="move or shrink it"):
        session.grow()
    assert not session.queue.runs


def test_grow_makes_an_order_that_can_be_run_by_itself(session: Session, scene: Path) -> None:
    session.edits.put(replace(session.state.regions.poses["wing"], centre=(0.1, 0.35, 0.0)))
    first = session.grow()
    second = session.another_seed()
    assert (first, second) == ("001", "002") and session.shown == second
    run = session.queue.runs[first]
    order = RunOrder.read(run.folder)
    assert run.state == QUEUED and order.config["seed"] == 0 and session.queue.runs[second].seed == 1
    grown = load_edit_scene(run.folder / order.scene)
    assert np.allclose(grown.regions[0].to_canonical, session.state.regions.focal_regions()[0].to_canonical, atol=1e-7)
    assert b"<!-- mine -->" in (run.folder / order.scene).read_bytes()
    assert scene.read_bytes() == session.state.source.text  # the user's own file is as it was


def test_save_scene_keeps_everything_else(session: Session, scene: Path) -> None:
    before = scene.read_text()
    assert session.save_scene() == "scene.xml has all that already"
    session.edits.put(replace(session.state.regions.poses["wing"], radii=(0.2, 0.2, 0.2)))
    session.edits.set_prompt("a pig with a horn")
    assert session.save_scene() == "saved in scene.xml"
    after = scene.read_text()
    assert (
        "<!-- mine -->" in after
        and 'value="a pig with a horn"' in after
        and '<scale x="0.2" y="0.2" z="0.2"/>' in after
    )
    assert len(after.splitlines()) - len(before.splitlines()) == 3
    saved = load_edit_scene(scene)
    assert saved.prompt == "a pig with a horn"
    assert np.allclose(saved.regions[0].to_canonical, session.state.regions.focal_regions()[0].to_canonical)
    assert session.save_scene() == "scene.xml has all that already"


def test_save_scene_refuses_regions_that_changed_in_the_file(session: Session, scene: Path) -> None:
    scene.write_text(scene.read_text().replace('y="0.35"', 'y="0.4"'))
    before = scene.read_bytes()
    session.edits.set_prompt("a pig with a horn")
    with pytest.raises(UserError, match="regions were changed since it was opened here; open it again"):
        session.save_scene()
    assert scene.read_bytes() == before


def test_a_scene_without_regions_gets_its_first_one_here(make_scene, mi, tmp_path: Path, checks: None) -> None:
    scene = make_scene(region="")
    session = opened(scene, tmp_path / "work")
    assert session.state.selected == "" and "no region yet" in str(session.checks.now().refusal)
    session.edits.add()
    session.edits.set_prompt("a pig with a horn")
    session.save_scene()
    session.close()
    assert [region.name for region in load_edit_scene(scene).regions] == ["region"]


def test_scene_that_was_edited_meanwhile_is_taken_anew(session: Session, scene: Path, tmp_path: Path) -> None:
    session.edits.set_prompt("a pig with a horn")
    session.save()
    scene.write_text(scene.read_text().replace("two wings", "a tail"))
    again = opened(scene, tmp_path / "work")
    assert again.state.prompt == "a pig with a tail"
    again.close()
    elsewhere = scene.with_name("other.xml")
    elsewhere.write_text(scene.read_text())
    with pytest.raises(UserError, match="work folder of another scene"):
        opened(elsewhere, tmp_path / "work")


def test_work_folder_is_enough_to_start_again(session: Session, scene: Path, tmp_path: Path) -> None:
    session.edits.set_prompt("a pig with a horn")
    name = session.grow()
    session.queue.stop(name)
    session.close()
    again = opened(tmp_path / "work", tmp_path / "work")
    assert again.state.prompt == "a pig with a horn" and again.shown == name
    again.queue.resume(name)
    assert RunOrder.read(again.queue.runs[name].folder).resume
    again.close()
    shown = open_target(tmp_path / "work" / "runs" / name, None, {})
    assert shown.shown == name and shown.work.path == (tmp_path / "work").resolve()


def test_bad_folders_are_refused(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    with pytest.raises(UserError, match="is no work folder of the studio and not empty"):
        opened(scene, tmp_path / "full")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "studio.json").write_text("{}")
    with pytest.raises(UserError, match="damaged or of another version"):
        opened(tmp_path / "bad", tmp_path / "bad")


def test_damaged_record_leaves_the_scene(session: Session, scene: Path, tmp_path: Path) -> None:
    record = json.loads(session.work.record.read_text())
    record["regions"] = [{"name": "wing"}]
    session.work.record.write_text(json.dumps(record))
    again = opened(scene, tmp_path / "work")
    assert again.state.regions.poses == session.state.regions.poses
    again.close()


def test_edit_again_needs_a_result(session: Session) -> None:
    name = session.grow()
    with pytest.raises(UserError, match="run 001: has no result yet"):
        session.edit_again(name)
    with pytest.raises(UserError, match="there is no run yet"):
        session.edit_again("")


def test_no_path_of_the_disk_is_shown(session: Session, tmp_path: Path, checks: None) -> None:
    line = f"{tmp_path}/my files/scene.xml:3: <shape>: {tmp_path}/files/scene/a.ply is gone, see https://x.org/a/b"
    shown = without_paths(line, tmp_path / "my files")
    assert shown == "scene.xml:3: <shape>: a.ply is gone, see https://x.org/a/b"
    session.edits.set_prompt("a pig with a submarine")
    report = session.checks.now()
    for text in (str(report.refusal), *report.warnings, *report.regions):
        assert not re.search(r"(^|\s)/\w+/", session.plain(text))


def test_undo_and_redo(session: Session) -> None:
    session.edits._history = History(clock=iter(range(0, 1000, 10)).__next__)  # nothing follows at once
    first = session.state.regions.poses["wing"]
    moved = replace(first, centre=(0.2, 0.3, 0.0))
    session.edits.put(moved)
    image = session.edits.mirror("wing")
    session.edits.set_prompt("a pig with a hat")
    session.edits.remove(image)
    topics: list[str] = []
    session.subscribe(topics.append)
    session.edits.undo()
    assert list(session.state.regions.poses) == ["wing", image] and session.state.selected == image
    assert topics == ["prompt", "regions"]
    session.edits.undo()
    assert session.state.prompt == "a pig with two wings"
    session.edits.undo()
    session.edits.undo()
    assert session.state.regions.poses == {"wing": first}
    with pytest.raises(UserError, match="nothing to undo"):
        session.edits.undo()
    for _ in range(3):
        session.edits.redo()
    assert session.state.prompt == "a pig with a hat" and session.state.regions.poses["wing"] == moved
    session.edits.put(first)  # another way from here
    with pytest.raises(UserError, match="nothing to redo"):
        session.edits.redo()


def test_a_drag_is_one_change_to_undo(session: Session) -> None:
    times = iter([0.0, 0.1, 0.2, 5.0])
    session.edits._history = History(clock=times.__next__)
    first = session.state.regions.poses["wing"]
    for x in (0.1, 0.2, 0.3):
        session.edits.put(replace(first, centre=(x, 0.3, 0.0)))
    session.edits.put(replace(first, centre=(0.9, 0.3, 0.0)))
    session.edits.undo()
    assert session.state.regions.poses["wing"].centre[0] == 0.3
    session.edits.undo()
    assert session.state.regions.poses["wing"] == first


def test_only_a_finished_run_is_compared(session: Session) -> None:
    name = session.grow()
    with pytest.raises(UserError, match=f"run {name}: has no result yet"):
        session.compare(name)
    session.compare("")
    assert session.beside == ""
