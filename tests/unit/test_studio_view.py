"""The page's two sides stay in step with the session, and do not drive each other in circles."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fd_mitsuba.assets.asset import Asset
from fd_mitsuba.assets.readers import read_asset
from fd_mitsuba.io.ply import ply_bytes
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.studio.job import EventWriter
from fd_mitsuba.studio.opening import open_target
from fd_mitsuba.studio.run_state import FINISHED
from fd_mitsuba.studio.session import Session
from fd_mitsuba.studio.settings import StudioSettings

viser = pytest.importorskip("viser")
from fd_mitsuba.studio.view import View  # noqa: E402


class Client:
    """Stands for a tab: remembers what it was told."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def add_notification(self, title: str, body: str, **options: Any) -> None:
        self.notes.append(body)


@pytest.fixture
def view(make_scene, mi, tmp_path: Path) -> Iterator[View]:
    opened = open_target(make_scene(), tmp_path / "work", {}, say=lambda line: None)
    session = Session(opened, StudioSettings("smoke"), program=(sys.executable, "-I", "-c", ""))
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    made = View(server, session)
    yield made
    made.close()
    server.stop()
    session.close()


def typed(field: Any, value: Any, client: Client) -> None:
    """As viser does when a client changes a field: the handle has the value, then the handlers are called."""
    field._impl.value = value
    for handler in field._impl.update_cb:
        handler(SimpleNamespace(client=client, target=field))


def test_gizmo_fields_and_regions_follow_each_other(view: View) -> None:
    state, panel = view.session.state, view.panel
    topics: list[str] = []
    view.session.subscribe(topics.append)
    place, half_turn = np.array([0.3, 0.5, -0.1]), np.array([0.0, 0.0, 1.0, 0.0])
    view._gizmo_moved(place, half_turn)
    pose = state.regions.poses["wing"]
    assert state.regions.frame.to_canonical(np.array(pose.centre)) == pytest.approx(place)
    assert panel.centre.value == pytest.approx(pose.centre, abs=6e-4)
    assert view.canvas._regions["wing"].position == pytest.approx(place)
    assert topics == ["pose"]  # setting the fields has called no handler of a person
    typed(panel.radii[1], 0.4, Client())
    assert state.regions.poses["wing"].radii == pytest.approx((0.12, 0.4, 0.15))
    assert state.regions.poses["wing"].centre == pose.centre  # three digits of a field do not become the value
    assert view.canvas._gizmo.position == pytest.approx(place)
    assert topics == ["pose", "pose"]


def test_refused_input_is_told_and_taken_back(view: View) -> None:
    client = Client()
    typed(view.panel.part, "a/b", client)
    assert "cannot name a file" in client.notes[0] and view.panel.part.value == "part"
    typed(view.panel.runs.seed, -1, client)
    assert "seed" in client.notes[1] and view.panel.runs.seed.value == 0
    typed(view.panel.part, "", client)  # while another name is being typed
    assert len(client.notes) == 2 and view.session.state.regions.poses["wing"].part == "part"


def test_growing_part_is_shown(view: View) -> None:
    session = view.session
    name = session.grow()
    assert not view.canvas.objects.has_part and "waits for its turn" in view.panel.runs.status.content
    run = session.queue.runs[name]
    vertices, faces = unit_sphere(2)
    run.live_mesh.write_bytes(ply_bytes(vertices, faces))
    events = EventWriter(run.folder)
    losses = {"loss_sds": 2.0}
    for step in (1, 2):
        events.write("step", stage="geometry", phase="coarse", step=step, total=4, losses=losses)
    events.write("mesh", step=1, faces=len(faces))
    run.follow()
    session.tell("runs")
    shown = view.canvas.objects._shown["part"].handle
    assert shown.vertices == pytest.approx(session.state.regions.frame.to_canonical(vertices), abs=1e-6)
    assert "geometry, step 2 of 4" in view.panel.runs.status.content and view.panel.runs.bar.value == 50
    assert view.canvas._regions["wing"].opacity < 0.2 and view.panel.runs.stop.visible
    objects = view.canvas.objects
    view.canvas.visible["wireframe"] = True
    view.canvas.apply_visibility()
    assert objects._shown["part"].lines.wireframe and objects._shown["base"].lines.visible


def test_surfaces_can_be_shown_as_colours_or_normals(view: View, tmp_path: Path) -> None:
    client, objects, vertices = Client(), view.canvas.objects, unit_sphere(2)[0]
    box = read_asset(Path(__file__).parents[1] / "data" / "assets" / "box.glb").meshes[0]
    objects.show_part(box.vertices, box.faces, view.session.state.regions.frame)
    typed(view.panel.shading, "normals", client)
    for name in ("base", "part"):
        (tmp_path / f"{name}.glb").write_bytes(objects._shown[name].handle.glb_data)
    asset = read_asset(tmp_path / "part.glb")
    (mesh,) = asset.meshes
    assert asset.materials[0].unlit and mesh.normals is not None and mesh.colours is not None
    corners = mesh.vertices[mesh.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    shown = np.where(mesh.colours > 0.0031308, 1.055 * np.maximum(mesh.colours, 0) ** (1 / 2.4) - 0.055, 0)
    assert np.allclose(shown[mesh.faces], (flat[:, None] + 1) / 2, atol=1e-3)  # a box has sharp edges
    base = read_asset(tmp_path / "base.glb").meshes[0]
    assert np.allclose(np.ptp(base.vertices, axis=0), np.ptp(view.session.state.base.vertices, axis=0), atol=1e-6)
    typed(view.panel.shading, "base colour", client)
    (tmp_path / "base.glb").write_bytes(objects._shown["base"].handle.glb_data)
    assert all(material.unlit for material in read_asset(tmp_path / "base.glb").materials)
    objects.show_part(vertices, unit_sphere(2)[1], view.session.state.regions.frame)  # what grows is clay even so
    typed(view.panel.light, "sunset", client)
    typed(view.panel.shading, "lit", client)
    assert objects._shown["base"].handle.glb_data == view.session.state.glb and client.notes == []


def test_materials_are_tried_on_the_part_alone(view: View, tmp_path: Path) -> None:
    """In the page: as it grows, and with its learned material, whose normal map stays; the base keeps its own."""
    client, objects, frame = Client(), view.canvas.objects, view.session.state.regions.frame
    learned = (Path(__file__).parents[1] / "data" / "assets" / "maps.glb").read_bytes()

    def shown() -> Asset:
        (tmp_path / "part.glb").write_bytes(objects._shown["part"].handle.glb_data)
        return read_asset(tmp_path / "part.glb")

    objects.show_part(*unit_sphere(2), frame)
    typed(view.panel.material, "gold", client)
    (gold,) = shown().materials
    assert (gold.metallic, gold.roughness) == (1.0, 0.25) and gold.base_color == pytest.approx((1.0, 0.71, 0.29))
    objects.show_part(*unit_sphere(2), frame, learned)
    before = read_asset(Path(__file__).parents[1] / "data" / "assets" / "maps.glb")
    assert any(material.base_texture for material in before.materials)
    for material, own in zip(shown().materials, before.materials, strict=True):
        assert material.metallic == 1.0 and material.base_texture is None
        assert (material.normal_texture is None) == (own.normal_texture is None)
    assert objects._shown["base"].handle.glb_data == view.session.state.glb
    typed(view.panel.material, "as learned", client)
    assert objects._shown["part"].handle.glb_data == learned and client.notes == []


def test_a_part_has_words_of_its_own(view: View) -> None:
    state, client = view.session.state, Client()
    typed(view.panel.part_prompt, " bat  wings", client)
    assert state.regions.poses["wing"].prompt == "bat wings" and view.panel.part_prompt.value == " bat  wings"
    check = view.session.checks.now()
    assert "bat wings" in check.understood or "part: " in check.understood
    name = view.session.edits.mirror("wing", 1)
    assert view.panel.region.value == name and view.panel.part_prompt.value.split() == ["bat", "wings"]
    view.session.edits.undo()
    view.session.edits.undo()
    assert view.panel.part_prompt.value == ""


def test_selected_region_leaves_clicks_to_its_gizmo(view: View) -> None:
    name = view.session.edits.mirror("wing", 1)
    assert view.canvas._clickable == {"wing"} and view.panel.region.value == name
    view.session.edits.select("wing")
    assert view.canvas._clickable == {name}


def test_a_finished_result_stands_beside(view: View) -> None:
    session, client = view.session, Client()
    name = session.grow()
    run = session.queue.runs[name]
    (run.folder / "export").mkdir(parents=True)
    glb = session.state.glb
    (run.folder / "export" / "asset.glb").write_bytes(glb)
    run.state = FINISHED
    session.show("")
    label = view.panel.runs.beside.options[1]
    typed(view.panel.runs.beside, label, client)
    handle = view.canvas.objects._beside
    assert handle.glb_data == glb and client.notes == []
    base = view.canvas.objects._shown["base"].handle
    apart = np.array(handle.position) - np.array(base.position)
    assert apart[0] > np.ptp(session.state.base.vertices[:, 0]) and apart[1:] == pytest.approx([0, 0])
    typed(view.panel.runs.beside, view.panel.runs.beside.options[0], client)
    assert view.canvas.objects._beside is None and session.beside == ""


def test_buttons_undo_what_was_done(view: View) -> None:
    client, state = Client(), view.session.state
    typed(view.panel.radii[1], 0.4, client)
    view.session.edits.undo()
    assert state.regions.poses["wing"].radii == pytest.approx((0.12, 0.25, 0.15))
    assert view.panel.radii[1].value == pytest.approx(0.25, abs=1e-3)
