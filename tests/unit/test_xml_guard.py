"""What Mitsuba gets to read says the same as the user's file: Mitsuba's own reading of that file is the oracle."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.run_folder import describe_run, identity
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.normalised_xml import normalise
from fd_mitsuba.scene.scene_file import SceneFile
from fd_mitsuba.scene.xml_guard import scan_scene

Make = Callable[..., Path]
HEAD = '<scene version="3.0.0">'


def nodes_of(mi: Any, state: Any) -> list[tuple[str, ...]]:
    """Every object: its type, plugin, id and properties, links included, with their names."""
    return [(str(n.type), n.props.plugin_name(), n.props.id(), str(n.props)) for n in state.nodes]


def read_both(mi: Any, path: Path, parameters: dict[str, str]) -> tuple[list, list]:
    """Mitsuba's reading of the file, and of what the guard makes of it."""
    config = mi.parser.ParserConfig(mi.variant())
    config.unused_parameters = mi.LogLevel.Debug
    literal = {name: value.replace("$", "\\$") for name, value in parameters.items()}
    theirs = mi.parser.parse_file(config, str(path), **literal)
    ours = mi.parser.parse_string(config, normalise(scan_scene(path, parameters, all_used=False).root).text)
    return nodes_of(mi, theirs), nodes_of(mi, ours)


NAMES = st.sampled_from(["a", "ab", "abc", "b_2", "long"])
LETTERS = st.characters(codec="utf-8", categories=["L", "N", "P", "S", "Zs"], include_characters='\t\n"<&>')
VALUES = st.lists(st.one_of(NAMES.map("${}".format), st.just("\\$x"), st.text(LETTERS, max_size=6).map(
    lambda text: text.replace("$", "").replace("\\", ""))), max_size=4).map("".join)  # fmt: skip


def attribute(value: str) -> str:
    return quoteattr(value, {"\n": "&#10;", "\t": "&#9;"})


@st.composite
def scenes(draw: st.DrawFn) -> tuple[str, str]:
    """A scene with its names, and one that it includes."""
    texts = []
    for level in range(2):
        pieces = [f'<default name="{name}" value="-{name}{level}"/>' for name in draw(st.lists(NAMES, max_size=3))]
        for number in range(draw(st.integers(0, 3))):
            inner = f"<string name={attribute('s' + str(number))} value={attribute(draw(VALUES))}/>"
            inner += f'<bsdf type="diffuse"><rgb name="reflectance" value="0.{number}, .2, 1e-3"/></bsdf>'
            pieces.append(f'<shape type="sphere" id="i{level}_{number}"><!-- <x> -->{inner}</shape>')
        if level == 0:
            pieces.insert(draw(st.integers(0, len(pieces))), '<include filename="more.xml"/>')
        texts.append("\n".join([HEAD, *pieces, "</scene>"]))
    return texts[0], texts[1]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=150)
@given(scenes(), st.dictionaries(NAMES, st.sampled_from(["-plain", " ", ": 5$", "& <b> ü"]), min_size=3))
def test_the_same_objects_come_out(mi: Any, tmp_path: Path, texts: tuple[str, str], parameters: dict[str, str]) -> None:
    # No value begins with a letter: to Mitsuba, `$ab$x` with x = "c" is `$abc`.
    parameters = {"a": ".everything", **parameters}  # `$a` begins every name that has no value of its own but two
    path = tmp_path / "scene.xml"
    path.write_text(texts[0], encoding="utf-8")
    (tmp_path / "more.xml").write_text(texts[1], encoding="utf-8")
    try:
        theirs, ours = read_both(mi, path, parameters)
    except (RuntimeError, UserError) as error:
        assert "undefined parameter" in str(error)
        with pytest.raises(RuntimeError, match="undefined parameter"):
            mi.parser.parse_file(mi.parser.ParserConfig(mi.variant()), str(path), **parameters)
        with pytest.raises(UserError, match="undefined parameter"):
            scan_scene(path, parameters, all_used=False)
    else:
        assert theirs == ours


WHOLE = f"""{HEAD}
  <default name="kind" value="twosided"/>
  <include filename="sub/material.xml" name="surface"/>
  <include filename="sub/shapes.xml"/>
  <alias id="red" as="rot"/>
  <shape type="sphere"><ref id="rot" name="bsdf"/><transform name="to_world"><rotate x="1" angle="$turn"/>
    <lookat origin="1, 2, 3" target="0 0 0" up="0 1 0"/>
    <matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform></shape>
</scene>"""


def test_includes_are_put_in_place(mi: Any, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "material.xml").write_text(
        '<bsdf version="3.0.0" type="$kind" id="red"><bsdf type="diffuse"/></bsdf>'
    )
    (tmp_path / "sub" / "shapes.xml").write_text(
        f'{HEAD}<default name="turn" value="30"/><shape type="cube" id="c"><ref id="red"/></shape>'
        '<shape type="disk" name="d"/></scene>'
    )
    path = tmp_path / "scene.xml"
    path.write_text(WHOLE)
    theirs, ours = read_both(mi, path, {})
    assert len(theirs) == 6 and theirs == ours


def test_messages_name_the_line_of_an_included_file(make_scene: Make, tmp_path: Path) -> None:
    (tmp_path / "more.xml").write_text(
        f'{HEAD}\n\n<bsdf type="diffuse">\n<float name="reflectance" value="red"/></bsdf></scene>'
    )
    with pytest.raises(UserError, match=r'more\.xml:4: <bsdf type="diffuse">: <float name="reflectance">: .*"red"'):
        load_edit_scene(make_scene(extra='<include filename="more.xml"/>'))
    (tmp_path / "more.xml").write_text(
        f'{HEAD}\n\n<bsdf\ntype="diffuse" id="q"><float name="colour" value="1"/></bsdf></scene>'
    )
    with pytest.raises(UserError, match=r'more\.xml:3: <bsdf type="diffuse" id="q">: .*colour'):
        load_edit_scene(make_scene(extra='<include filename="more.xml"/>'))


def test_generations_of_mitsuba_do_not_mix(make_scene: Make, tmp_path: Path) -> None:
    (tmp_path / "more.xml").write_text('<scene version="0.6.0"/>')
    with pytest.raises(UserError, match=r"more\.xml is of version 0\.6\.0, the scene of 3\.0\.0"):
        load_edit_scene(make_scene(extra='<include filename="more.xml"/>'))


def test_paths_are_searched(make_scene: Make, tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    path = make_scene(extra='<path value="meshes"/>')
    (tmp_path / "animal.ply").rename(tmp_path / "meshes" / "animal.ply")
    assert load_edit_scene(path).files[1] == (tmp_path / "meshes" / "animal.ply").resolve()


SPECTRUM = '<bsdf type="diffuse" id="part"><spectrum name="reflectance" filename="grey.spd"/></bsdf>'


def test_a_spectrum_file_means_what_it_means_to_mitsuba(mi: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)  # where Mitsuba looks, too
    (tmp_path / "grey.spd").write_text("# a comment\n360 0.1\n450.5  .25e0 \n\n600 0.3 a comment\n830 7e-1\r\n")
    (tmp_path / "scene.xml").write_text(f'{HEAD}<shape type="sphere" id="ball">{SPECTRUM}</shape></scene>')
    config = mi.parser.ParserConfig(mi.variant())
    values = []
    for state in (
        mi.parser.parse_file(config, "scene.xml"),
        mi.parser.parse_string(config, normalise(scan_scene(tmp_path / "scene.xml", {}).root).text),
    ):
        mi.parser.transform_all(config, state)
        parameters = mi.traverse(mi.parser.instantiate(config, state))
        values.append(np.array(parameters[next(key for key in parameters.keys() if "reflectance" in key)]))
    assert values[0].size == 3 and np.ptp(values[0]) > 0.01 and np.array_equal(*values)


def test_a_spectrum_file_is_part_of_what_a_run_is_made_of(make_scene: Make, tmp_path: Path) -> None:
    (tmp_path / "grey.spd").write_text("360 0.1\n830 0.7\n")
    scene = load_edit_scene(make_scene(part=SPECTRUM))
    assert tmp_path / "grey.spd" in scene.files
    before = identity(scene, RunConfig(), tmp_path / "run")
    describe_run(scene, RunConfig(), tmp_path / "run", "run")
    assert (tmp_path / "run" / "scene" / "grey.spd").read_text() == "360 0.1\n830 0.7\n"
    (tmp_path / "grey.spd").write_text("360 0.1\n830 0.8\n")
    assert identity(load_edit_scene(scene.path), RunConfig(), tmp_path / "run")["scene_hash"] != before["scene_hash"]
    assert SceneFile(tmp_path / "run" / "scene" / "scene.xml").files["grey.spd"].parent.name == "scene"
