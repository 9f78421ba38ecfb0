"""Every bad scene ends in one line that names file, element and remedy; nothing crashes and nothing is half-read."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import BASE, INTEGRATOR, LIGHT, REGION, write_ply

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere

Make = Callable[..., Path]


def region(transform: str = "", inner: str = "") -> str:
    return f'<shape type="focal_region" id="wing">{inner}<transform name="to_world">{transform}</transform></shape>'


def dual_path(prompt: str) -> str:
    return f'<integrator type="dual_path"><string name="prompt" value="{prompt}"/></integrator>'


NEAR = '<scale value="0.2"/><translate y="0.3"/>'
OTHER_BASE = '<shape type="{kind}" id="body">{inner}</shape>'

# name: (pieces of the scene that differ, words that the message must hold)
CASES: dict[str, tuple[dict[str, str], tuple[str, ...]]] = {
    "wrong root element": ({"root": '<shape version="3.0.0" type="cube">'}, ("<shape>", "<scene>")),
    "missing version": ({"root": "<scene>"}, ("version", '<scene version="3.0.0">')),
    "unknown element": ({"extra": "<sphere/>"}, (":2:", "<sphere>", "mend")),
    "broken xml": ({"extra": "<bsdf type='diffuse'>"}, ("XML", "mend")),
    "no base shape": ({"base": ""}, ("no base shape", "add")),
    "no focal region": ({"region": ""}, ("no focal region", "add")),
    "no dual_path": ({"integrator": '<integrator type="path"/>'}, ("dual_path", "add")),
    "no integrator": ({"integrator": ""}, ("dual_path", "add")),
    "two integrators": ({"extra": INTEGRATOR}, ("dual_path", "keep one")),
    "prompt missing": ({"integrator": '<integrator type="dual_path"/>'}, ("dual_path", "prompt", "add")),
    "prompt empty": ({"integrator": dual_path("")}, ("prompt", "add")),
    "prompt blank": ({"integrator": dual_path("  &#9; ")}, ("prompt", "add")),
    "prompt far too long": ({"integrator": dual_path("crown " * 17000)}, ("prompt has 101999 characters", "at most")),
    "prompt not text": (
        {"integrator": '<integrator type="dual_path"><float name="prompt" value="3"/></integrator>'},
        ("prompt", "not text"),
    ),
    "region outside the grid": ({"region": region('<translate x="40"/>')}, ("wing", "cube", "move")),
    "region far larger than the grid": ({"region": region('<scale value="30"/>')}, ("wing", "cube", "shrink")),
    "region never touches the base": (
        {"region": region('<scale value="0.04"/><translate x="0.55" y="0.5" z="-0.4"/>')},
        ("wing", "away from the base", "move it closer"),
    ),
    "region prompt blank": (
        {"region": region(NEAR, '<string name="prompt" value=" "/>')},
        ("wing", "prompt is blank", "remove it"),
    ),
    "region prompt far too long": (
        {"region": region(NEAR, f'<string name="prompt" value="{"wing " * 500}"/>')},
        ("wing", "prompt has 2499 characters", "at most"),
    ),
    "region prompt not text": (
        {"region": region(NEAR, '<float name="prompt" value="2"/>')},
        ("wing", "prompt", "not text"),
    ),
    "region negative prompt alone": (
        {"region": region(NEAR, '<string name="negative_prompt" value="blurry"/>')},
        ("wing", "without a prompt", "add"),
    ),
    "two prompts of one part": (
        {
            "region": region(NEAR, '<string name="prompt" value="a hat"/>')
            + region(NEAR, '<string name="prompt" value="wings"/>').replace("wing", "other", 1)
        },
        ("other", "wing", "'a hat'", "'wings'", "another part"),
    ),
    "region singular": ({"region": region('<scale x="0" y="1" z="1"/>')}, ("wing", "singular", "scales other than 0")),
    "region NaN": ({"region": region('<translate x="nan"/>')}, ("wing", "NaN", "correct")),
    "region infinite": ({"region": region('<scale value="inf"/>')}, ("wing", "infinity", "correct")),
    "base singular": (
        {"base": BASE.replace("<bsdf", '<transform name="to_world"><scale y="0"/></transform><bsdf')},
        ("body", "singular"),
    ),
    "base NaN transform": (
        {"base": BASE.replace("<bsdf", '<transform name="to_world"><translate y="nan"/></transform><bsdf')},
        ("body", "NaN"),
    ),
    "two faces": ({"base": OTHER_BASE.format(kind="rectangle", inner="")}, ("2 faces", "volume", "solid")),
    "curve as base": ({"base": OTHER_BASE.format(kind="shapegroup", inner="<shape type='cube'/>")}, ("body", "mesh")),
    "missing mesh file": ({"base": BASE.replace("animal.ply", "gone.ply")}, ("body", "gone.ply", "correct")),
    "missing region mesh": (
        {"region": region(NEAR, '<string name="filename" value="gone.ply"/>')},
        ("wing", "gone.ply"),
    ),
    "region mesh of another type": (
        {"region": region(NEAR, '<string name="filename" value="scene.xml"/>')},
        ("wing", "scene.xml", ".ply"),
    ),
    "missing envmap": (
        {"light": '<emitter type="envmap" id="sky"><string name="filename" value="gone.exr"/></emitter>'},
        ("envmap", "sky", "gone.exr"),
    ),
    "envmap that is no picture": (
        {"light": '<emitter type="envmap" id="sky"><string name="filename" value="scene.xml"/></emitter>'},
        ("sky",),
    ),
    "undefined parameter": ({"integrator": dual_path("$words")}, ("$words", "-D")),
    "unknown plugin": ({"part": '<bsdf type="principld" id="part"/>'}, ("principld", "nearest: principled")),
    "misspelt property": (
        {"part": '<bsdf type="principled" id="part"><float name="roughnes" value="0.5"/></bsdf>'},
        ("part", "roughnes", "correct its name"),
    ),
    "misspelt property of a region": (
        {"region": region(NEAR, '<string name="prt" value="hat"/>')},
        ("wing", "prt", "correct its name"),
    ),
    "unknown shape of a region": (
        {"region": region(NEAR, '<string name="shape" value="bx"/>')},
        ("wing", "unknown region shape 'bx'", "nearest: box"),
    ),
    "misspelt property of a region's shape": (
        {"region": region(NEAR, '<string name="shape" value="cylinder"/><float name="tp" value="0.5"/>')},
        ("wing", "no property 'tp'", "nearest: top", "correct its name"),
    ),
    "wrong property of a region's shape": (
        {"region": region(NEAR, '<string name="shape" value="cylinder"/><float name="top" value="-1"/>')},
        ("wing", "shape (cylinder): top", "greater than 0", "-1"),
    ),
    "a property of another shape": (
        {"region": region(NEAR, '<string name="shape" value="box"/><float name="top" value="1"/>')},
        ("wing", "no property 'top'", "correct its name"),
    ),
    "region with shape and file": (
        {"region": region(NEAR, '<string name="shape" value="box"/><string name="filename" value="animal.ply"/>')},
        ("wing", "has the shape 'box' and a filename", "keep one"),
    ),
    "misspelt property of dual_path": (
        {"integrator": INTEGRATOR.replace("base_prompt", "base_promt")},
        ("dual_path", "base_promt"),
    ),
    "misspelt property of the base": (
        {"base": BASE.replace("<bsdf", '<float name="radius" value="1"/><bsdf')},
        ("body", "radius"),
    ),
    "wrong kind of value": (
        {"part": '<bsdf type="principled" id="part"><float name="roughness" value="soft"/></bsdf>'},
        ("soft", "value"),
    ),
    "duplicate id": ({"part": '<bsdf type="diffuse" id="body"/>'}, ("duplicate", "body", "own id")),
    "reference to nothing": ({"base": BASE.replace('<bsdf type="diffuse"/>', '<ref id="paint"/>')}, ("body", "paint")),
    "circle of references": (
        {"extra": '<bsdf type="twosided" id="x"><ref id="y"/></bsdf><bsdf type="twosided" id="y"><ref id="x"/></bsdf>'},
        ("circular", "<ref>"),
    ),
    "part name is a path": (
        {"region": region(NEAR, '<string name="part" value="../wing"/>')},
        ("wing", "../wing", "use letters"),
    ),
    "part name is base": ({"region": region(NEAR, '<string name="part" value="base"/>')}, ("wing", "'base'")),
    "plugin by path": ({"extra": '<shape type="../../evil"/>'}, ("../../evil", "plugin name")),
    "plugin by path through a default": (
        {"extra": '<default name="kind" value="../evil"/><shape type="$kind"/>'},
        ("../evil", "plugin name"),
    ),
    "include outside": ({"extra": '<include filename="../other.xml"/>'}, ("../other.xml", "outside")),
    "include absolute": ({"extra": '<include filename="/etc/passwd"/>'}, ("/etc/passwd", "outside")),
    "include missing": ({"extra": '<include filename="more.xml"/>'}, ("more.xml", "not found")),
    "include of itself": ({"extra": '<include filename="scene.xml"/>'}, ("include", "15")),
    "deep tags": ({"extra": "<bsdf type='twosided'>" * 20000 + "</bsdf>" * 20000}, ("nested", "100")),
    "deep twosided": ({"extra": "<bsdf type='twosided'>" * 40 + "</bsdf>" * 40}, ("nested", "16")),
}


def message_of(path: Path, parameters: dict[str, str] | None = None) -> str:
    with pytest.raises(UserError) as caught:
        load_edit_scene(path, parameters)
    message = str(caught.value)
    assert "\n" not in message and "Traceback" not in message and ".cpp" not in message and "\x1b" not in message
    assert str(path) in message and len(message) < 500
    return message


@pytest.mark.parametrize(("plugin", "suffix"), [("stl", "stl"), ("obj", "glb"), ("ply", "off")])
def test_a_mesh_in_a_format_that_mitsuba_does_not_read(
    make_scene: Make, tmp_path: Path, plugin: str, suffix: str
) -> None:
    trimesh.creation.icosphere().export(tmp_path / f"ball.{suffix}")
    message = message_of(make_scene(base=BASE.replace('"ply"', f'"{plugin}"').replace("animal.ply", f"ball.{suffix}")))
    for word in ("body", f"ball.{suffix}", "PLY, OBJ", f"fd_mitsuba import ball.{suffix}"):
        assert word in message, message


@pytest.mark.parametrize("name", CASES)
def test_bad_scene(make_scene: Make, name: str) -> None:
    pieces, words = CASES[name]
    message = message_of(make_scene(**pieces))
    print(message)
    for word in words:
        assert word in message, message


def test_missing_scene(tmp_path: Path) -> None:
    assert "no such scene file" in message_of(tmp_path / "none.xml")


def test_folder_instead_of_a_scene(tmp_path: Path) -> None:
    assert "is a folder" in message_of(tmp_path)


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "empty"), (b" \n\n", "empty"), (b"a pig with wings", "not an XML file"), (b"\x89PNG\0\0\1", "binary"),
     (b"<!-- only a comment -->", "empty"), (b"\xff\xfe\x00", "not an XML file")],
)  # fmt: skip
def test_file_that_is_no_scene(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "scene.xml"
    path.write_bytes(content)
    assert words in message_of(path)


def test_unknown_parameter_names_the_nearest(make_scene: Make) -> None:
    path = make_scene(extra='<default name="prompt" value="a pig"/>', integrator=dual_path("$prompt"))
    assert "nearest: prompt" in message_of(path, {"promt": "x"})
    assert "no parameters" in message_of(make_scene(), {"promt": "x"})


def test_blank_prompt_by_parameter(make_scene: Make) -> None:
    path = make_scene(extra='<default name="prompt" value="a pig"/>', integrator=dual_path("$prompt"))
    assert "prompt" in message_of(path, {"prompt": " "})


def _closed_but_for_one_face(path: Path) -> None:
    vertices, faces = unit_sphere(2)
    write_ply(path, vertices, faces[1:])


def test_region_mesh_with_a_hole(make_scene: Make, tmp_path: Path) -> None:
    _closed_but_for_one_face(tmp_path / "region.ply")
    message = message_of(make_scene(region=region(NEAR, '<string name="filename" value="region.ply"/>')))
    assert "wing" in message and "region.ply" in message and "not closed" in message


def _nan(path: Path) -> None:
    vertices, faces = unit_sphere(2)
    vertices = vertices.copy()
    vertices[3] = np.nan
    write_ply(path, vertices, faces)


def _infinite(path: Path) -> None:
    vertices, faces = unit_sphere(2)
    write_ply(path, np.where(vertices > 0.9, np.inf, vertices), faces)


def _empty(path: Path) -> None:
    write_ply(path, np.zeros((0, 3)), np.zeros((0, 3)))


def _no_faces(path: Path) -> None:
    write_ply(path, np.eye(3), np.zeros((0, 3)))


def _two_faces(path: Path) -> None:
    write_ply(path, np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.1]]), np.array([[0, 1, 2], [0, 2, 3]]))


def _one_point(path: Path) -> None:
    vertices, faces = unit_sphere(1)
    write_ply(path, vertices * 0 + 3, faces)


def _index_out_of_range(path: Path) -> None:
    vertices, faces = unit_sphere(1)
    faces = faces.copy()
    faces[5, 1] = 10**7
    write_ply(path, vertices, faces)


def _binary_index_out_of_range(path: Path) -> None:
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    header += b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(header + np.eye(4, 3, dtype="<f4").tobytes() + struct.pack("<Biii", 3, 0, 1, 10**7))


def _binary_nan(path: Path) -> None:
    vertices, faces = unit_sphere(1)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
    )
    header += f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    body = np.where(vertices > 0.99, np.nan, vertices).astype("<f4").tobytes()
    path.write_bytes(header.encode() + body + b"".join(struct.pack("<Biii", 3, *face) for face in faces))


def _truncated(path: Path) -> None:
    write_ply(path, *unit_sphere(2))
    path.write_bytes(path.read_bytes()[:900])


def _not_a_ply(path: Path) -> None:
    path.write_text("this is no mesh")


MESHES = {
    "NaN vertices": (_nan, "NaN"),
    "NaN vertices in a binary file": (_binary_nan, "NaN"),
    "infinite vertices": (_infinite, "body"),
    "empty mesh": (_empty, "body"),
    "no faces": (_no_faces, "empty"),
    "two faces": (_two_faces, "volume"),
    "zero size": (_one_point, "at one point"),
    "index out of range": (_index_out_of_range, "out of range"),
    "binary index out of range": (_binary_index_out_of_range, "out of range"),
    "truncated": (_truncated, "animal.ply"),
    "no PLY at all": (_not_a_ply, "animal.ply"),
}


@pytest.mark.parametrize("name", MESHES)
def test_bad_base_mesh(make_scene: Make, tmp_path: Path, name: str) -> None:
    write, words = MESHES[name]
    path = make_scene()
    write(tmp_path / "animal.ply")
    message = message_of(path)
    print(message)
    assert words in message and "body" in message, message


@pytest.mark.parametrize("name", ["index out of range", "binary index out of range"])
def test_bad_indices_do_not_end_the_process(make_scene: Make, tmp_path: Path, name: str) -> None:
    path = make_scene()
    MESHES[name][0](tmp_path / "animal.ply")
    program = (
        "import sys\nfrom fd_mitsuba.errors import UserError\nfrom fd_mitsuba.scene.load_scene import load_edit_scene\n"
        "try:\n    load_edit_scene(sys.argv[1])\nexcept UserError as error:\n    print(error)\n    sys.exit(1)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1, done.stderr
    assert done.stdout.count("\n") == 1 and "Traceback" not in done.stderr


def test_the_good_scene_that_the_cases_start_from_is_good(make_scene: Make) -> None:
    assert load_edit_scene(make_scene(light=LIGHT, region=REGION)).prompt


def test_one_thread_can_read_an_exr(make_scene: Make, tmp_path: Path) -> None:
    """Mitsuba 3.9 waits forever for its own picture reader when Dr.Jit has a single thread."""
    sky = '<emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/></emitter>'
    program = """if True:
        import sys
        import numpy as np
        from fd_mitsuba.backend import startup
        from fd_mitsuba.scene.load_scene import load_edit_scene
        from fd_mitsuba.backend.file_threads import file_threads
        mi = startup.start(threads=1)
        import drjit as dr
        with file_threads():
            mi.Bitmap(np.ones((64, 128, 3), np.float32)).write(sys.argv[2])
        load_edit_scene(sys.argv[1])
        print(dr.thread_count())
    """
    arguments = [sys.executable, "-c", program, str(make_scene(light=sky)), str(tmp_path / "sky.exr")]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.strip() == "1", done.stderr
