"""Files that crashed, hung or misled Mitsuba end in one line, each in a process of its own: no signal, no hang."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import BASE, INTEGRATOR, LIGHT, write_ply
from fuzz.forked import REFUSED, USAGE, WORKS, Forked, Outcome

from fd_mitsuba.scene.tessellate import unit_sphere

Make = Callable[..., Path]
CASES = Path(__file__).parents[1] / "data" / "cases"
SECONDS = 10
"""After which a run counts as hung."""


@pytest.fixture(scope="module")
def forked() -> Iterator[Forked]:
    with Forked(SECONDS) as process:
        yield process


def refused(outcome: Outcome, *words: str) -> None:
    assert outcome.kind == REFUSED, (outcome.kind, outcome.code, outcome.errors[-2000:])
    for word in words:
        assert word in outcome.message, outcome.message
    assert outcome.message.count("\n") == 0 and len(outcome.message) < 600


KEPT = {
    "bitmap_no_filename/scene.xml": ("scene.xml:3:", "bitmap", "filename", "write"),
    "lamp_bad_index/scene.xml": ("scene.xml:4:", "lamp", "oobmax.ply", "out of range"),
    "lamp_bad_index/scene_abort.xml": ("scene_abort.xml:4:", "lamp", "oob.ply", "out of range"),
    "bad_utf8/scene.xml": ("scene.xml:2:", "UTF-8", "0xe4"),
    "wrong_type/sphere_radius_vector.xml": (":3:", 'id="base"', "radius is a vector", '<float name="radius"'),
    "wrong_type/region_filename_integer.xml": (":5:", 'id="top"', "filename is an integer", '<string name="filename"'),
}


@pytest.mark.parametrize("name", KEPT)
def test_kept_case(forked: Forked, name: str) -> None:
    refused(forked.run("check", CASES / name), *KEPT[name])


WRONG_TYPES = {
    "centre": (BASE.replace('"ply"', '"sphere"').replace('<string name="filename" value="animal.ply"/>',
               '<float name="center" value="1"/>'), "center is a number, not a point"),
    "cylinder": ('<shape type="cylinder" id="body"><string name="p0" value="1"/></shape>', "p0 is text, not a point"),
    "to_world": (BASE.replace("<bsdf", '<float name="to_world" value="2"/><bsdf'), "to_world is a number"),
    "file name": (BASE.replace('<string name="filename" value="animal.ply"/>', '<float name="filename" value="2"/>'),
                  "filename is a number, not text"),
    "object for a file name": (BASE.replace('<string name="filename" value="animal.ply"/>',
                               '<texture name="filename" type="checkerboard"/>'), "filename is an object"),
    "radius NaN": ('<shape type="sphere" id="body"><float name="radius" value="nan"/></shape>', "NaN"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_TYPES)
def test_wrong_type_of_a_known_property(forked: Forked, make_scene: Make, name: str) -> None:
    base, words = WRONG_TYPES[name]
    refused(forked.run("check", make_scene(base=base)), "scene.xml:8:", "body", words)


def test_a_blend_without_its_parts(forked: Forked, make_scene: Make) -> None:
    for inner in (
        "",
        '<bsdf type="diffuse"/><bsdf type="diffuse"/>',
        '<bsdf type="diffuse"/><float name="weight" value="1"/>',
    ):
        path = make_scene(part=f'<bsdf type="blendbsdf" id="part">{inner}</bsdf>')
        refused(forked.run("check", path), "scene.xml:9:", "part", "two BSDFs and a weight")


# Named pipes: nobody ever writes into them, so whoever opens one waits for ever.

PIPES = {
    "spectrum": {"part": '<bsdf type="diffuse" id="part"><spectrum name="reflectance" filename="pipe"/></bsdf>'},
    "include": {"extra": '<include filename="pipe"/>'},
    "picture": {"light": '<emitter type="envmap" id="sky"><string name="filename" value="pipe"/></emitter>'},
    "mesh": {"base": BASE.replace("animal.ply", "pipe")},
    "mesh of a region": {
        "region": '<shape type="focal_region" id="top"><string name="filename" value="pipe"/></shape>'
    },
}


@pytest.mark.parametrize("name", PIPES)
def test_a_named_pipe_in_a_scene(forked: Forked, make_scene: Make, tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    refused(forked.run("check", make_scene(**PIPES[name])), "scene.xml", "pipe", "not a regular file")


@pytest.mark.parametrize("option", ["-c", "--regions", "scene"])
def test_a_named_pipe_as_argument(forked: Forked, make_scene: Make, tmp_path: Path, option: str) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    arguments = [pipe] if option == "scene" else [make_scene(), option, pipe]
    refused(forked.run("check", *arguments), "pipe", "not a regular file")


def test_the_metal_of_a_conductor_is_no_path(forked: Forked, make_scene: Make, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.eta.spd")
    part = '<bsdf type="roughconductor" id="part"><string name="material" value="../../x"/></bsdf>'
    refused(forked.run("check", make_scene(part=part)), "scene.xml:9:", "'../../x' is not a name")


# Spectrum files are read by us.


def _spectrum(make_scene: Make, tmp_path: Path, text: bytes) -> Path:
    (tmp_path / "grey.spd").write_bytes(text)
    return make_scene(part='<bsdf type="diffuse" id="part"><spectrum name="reflectance" filename="grey.spd"/></bsdf>')


@pytest.mark.parametrize(
    ("text", "words"),
    [(b"400 0.1\n500 nan\n", "line 2: a number is not finite"), (b"", "holds 0 values"),
     (b"400 0.1\n400 0.2\n", "line 2: the wavelengths do not increase"), (b"400 red\n", "line 1: not a wavelength"),
     (b"400 0.1\n" + b"#" * (1 << 20), "more than 1.0 MB")],
)  # fmt: skip
def test_bad_spectrum_file(forked: Forked, make_scene: Make, tmp_path: Path, text: bytes, words: str) -> None:
    refused(forked.run("check", _spectrum(make_scene, tmp_path, text)), "scene.xml:9:", "grey.spd", words)


# What the XML says is understood once, by a strict parser.

HEAD = '<scene version="3.0.0">\n'
DEEP = "<bsdf type='twosided'>" * 200_000
BAD_XML: dict[str, tuple[bytes, tuple[str, ...]]] = {
    "DOCTYPE with a quote": (
        b'<!DOCTYPE scene SYSTEM "[">\n' + f"{HEAD}{DEEP}".encode(), ("xml:1:", "DOCTYPE", "remove")
    ),
    "entity in an included name": (
        f'{HEAD}<include filename="&x;.xml"/></scene>'.encode(), ("xml:2:", "not well-formed", "undefined entity")
    ),
    "attribute twice": (
        f'{HEAD}<shape type="sphere" id="a" type="cube"/></scene>'.encode(), ("xml:2:", "duplicate attribute")
    ),
    "200,000 elements deep": (f"{HEAD}{DEEP}".encode(), ("xml:2:", "nested deeper than 100")),
    "comments that never end": (f"{HEAD}{'<!--' * 9000}".encode(), ("xml:2:", "not well-formed")),
    "a long chain of references": (
        (HEAD + "".join(f'<bsdf type="twosided" id="b{n}"><ref id="b{n + 1}"/></bsdf>' for n in range(60_000))
         + '<bsdf type="diffuse" id="b60000"/></scene>').encode(),
        ("xml:2:", "nested deeper than 16"),
    ),
    "a lone surrogate": (f'{HEAD}<string name="a" value="&#xd800;"/></scene>'.encode(), ("xml:2:", "character")),
    "a control character": (f'{HEAD}<string name="a" value="&#27;x&#7;"/></scene>'.encode(), ("xml:2:", "character")),
    "an unknown encoding": (b'<?xml version="1.0" encoding="klingon"?><scene/>', ("xml:1:", "klingon", "UTF-8")),
    "text": (f"{HEAD}<string name='prompt'>a cat</string></scene>".encode(), ("xml:2:", "'a cat'", "value")),
    "an undefined name": (f'{HEAD}<shape type="$kind"/></scene>'.encode(), ("xml:2:", "parameter: $kind", "-D")),
    "a property twice": (
        f'{HEAD}<shape type="sphere"><float name="r" value="1"/>\n<float name="r" value="2"/></shape></scene>'.encode(),
        ("xml:3:", '<float name="r">', "'r' twice"),
    ),
    "a nested object twice": (
        f'{HEAD}<shape type="sphere"><bsdf type="diffuse" name="b"/>\n<ref id="x" name="b"/></shape></scene>'.encode(),
        ("xml:3:", "'b' twice"),
    ),
    "a version that is none": (b'<scene version="three"/>', ("xml:1:", "'three'", '<scene version="3.0.0">')),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_XML)
def test_xml_that_is_refused(forked: Forked, tmp_path: Path, name: str) -> None:
    data, words = BAD_XML[name]
    (tmp_path / "scene.xml").write_bytes(data)
    outcome = forked.run("check", tmp_path / "scene.xml")
    refused(outcome, *words)
    assert outcome.cpu_seconds < 8, outcome.cpu_seconds


def test_an_include_that_reaches_itself_through_a_link(forked: Forked, make_scene: Make, tmp_path: Path) -> None:
    (tmp_path / "again.xml").symlink_to("scene.xml")
    refused(forked.run("check", make_scene(extra='<include filename="again.xml"/>')), "<include>", "15")


def test_includes_that_multiply(forked: Forked, make_scene: Make, tmp_path: Path) -> None:
    """Fifteen levels of ten includes each would be 10^15 files."""
    for level in range(14):
        inner = f'<include filename="{level + 1}.xml"/>' * 10 if level < 13 else ""
        (tmp_path / f"{level}.xml").write_text(f"{HEAD}{inner}</scene>")
    refused(forked.run("check", make_scene(extra='<include filename="0.xml"/>')), "<include>", "more than 1000 files")


def test_reading_takes_time_in_proportion(forked: Forked, make_scene: Make) -> None:
    """A hundred thousand elements, each with its line, in a few seconds: were anything quadratic, it would be hours."""
    many = "\n".join(f'<bsdf type="diffuse" id="b{n}"/>' for n in range(100_000))
    outcome = forked.run("check", make_scene(extra=many, region=""), seconds=60)
    refused(outcome, "no focal region")
    assert outcome.cpu_seconds < 16, outcome.cpu_seconds


def test_control_characters_in_a_prompt_do_not_reach_the_terminal(forked: Forked, make_scene: Make) -> None:
    words = "a pig\u009b31m with \u202ewings"
    path = make_scene(integrator=INTEGRATOR.replace("a pig with two wings", words), region="")
    path.write_text(path.read_text().replace("</scene>", f'<shape type="focal_region" id="t{words}"/></scene>'))
    outcome = forked.run("check", path)
    assert outcome.kind in (WORKS, REFUSED), outcome.errors
    shown = outcome.output + outcome.errors
    assert "wings" in shown and not {"\u009b", "\u202e"} & set(shown)
    outcome = forked.run("check", make_scene(), "--prompt", "a \x1b]0;x\x07cat with wings")
    assert outcome.kind == WORKS and "x" in outcome.output and not {"\x1b", "\x07"} & set(outcome.output)


def test_arguments_that_are_not_utf8(forked: Forked, make_scene: Make) -> None:
    extra = '<default name="p" value="a pig"/>'
    path = make_scene(extra=extra, integrator=INTEGRATOR.replace("a pig with two wings", "$p"))
    for arguments in (("--prompt", "a c\udce4t"), ("-D", "p=a c\udce4t"), ("--set", "seed=\udce4")):
        refused(forked.run("check", path, *arguments), arguments[0], "UTF-8")


# Images and meshes whose headers announce more than they hold.


def _png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compressobj(9)
    packed = b"".join(rows.compress(b"\0" * (width + 1)) for _ in range(height)) + rows.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def _exr(width: int, height: int) -> bytes:
    def attribute(name: bytes, kind: bytes, value: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value

    box = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    channels = b"R\0" + struct.pack("<iiii", 1, 0, 1, 1) + b"\0"
    fields = attribute(b"channels", b"chlist", channels) + attribute(b"compression", b"compression", b"\0")
    fields += attribute(b"dataWindow", b"box2i", box) + attribute(b"displayWindow", b"box2i", box)
    return b"\x76\x2f\x31\x01\x02\0\0\0" + fields + b"\0"


BOMBS = {
    "PNG": lambda: _png(40_000, 40_000),
    "EXR": lambda: _exr(100_000, 100_000),
    "HDR": lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 100000\n",
    "PFM": lambda: b"PF\n100000 100000\n-1.0\n",
    "PPM": lambda: b"P6\n# many\n100000 100000\n255\n",
    "BMP": lambda: b"BM" + b"\0" * 12 + struct.pack("<Iii", 40, 100_000, -100_000) + b"\0" * 28,
    "JPEG": lambda: b"\xff\xd8\xff\xe0\0\x04ab\xff\xc0\0\x11\x08" + struct.pack(">HH", 65_500, 65_500) + b"\0" * 12,
    "TGA": lambda: b"\0" * 12 + struct.pack("<HH", 65_500, 65_500) + b"\0" * 40 + b"TRUEVISION-XFILE.\0",
}


@pytest.mark.parametrize("kind", BOMBS)
def test_picture_of_too_many_pixels(forked: Forked, make_scene: Make, tmp_path: Path, kind: str) -> None:
    data = BOMBS[kind]()
    assert len(data) < 2_000_000
    (tmp_path / "sky").write_bytes(data)
    light = '<emitter type="envmap" id="sky"><string name="filename" value="sky"/></emitter>'
    outcome = forked.run("check", make_scene(light=light))
    refused(outcome, "scene.xml:7:", "sky", "pixels", "shrink")
    assert outcome.megabytes < 600


@pytest.mark.parametrize(
    "data", [b"PF\n8 0x10\n-1.0\n" + bytes(384), b"PF\n8 0\n-1.0\n", b"P6\n0 4\n255\n", b"#?RADIANCE\n\n-Y x +X 4\n",
             _png(4, 4)[:20], _exr(0, 4), b"\xff\xd8\xff\xe0\0", b"BM" + bytes(100), b"PF\n"]
)  # fmt: skip
def test_a_picture_without_a_size(forked: Forked, make_scene: Make, tmp_path: Path, data: bytes) -> None:
    """Mitsuba divides by the number of its rows, and the process ends."""
    (tmp_path / "sky").write_bytes(data)
    light = '<emitter type="envmap" id="sky"><string name="filename" value="sky"/></emitter>'
    refused(forked.run("check", make_scene(light=light)), "scene.xml:7:", "sky", "how large the picture is")


def test_a_picture_within_the_limit_is_read(forked: Forked, make_scene: Make, tmp_path: Path) -> None:
    (tmp_path / "sky.png").write_bytes(_png(512, 256))
    light = '<emitter type="envmap" id="sky"><string name="filename" value="sky.png"/></emitter>'
    assert forked.run("check", make_scene(light=light)).kind == WORKS


def _ply(counts: tuple[object, object], kind: str = "ascii") -> bytes:
    head = f"ply\nformat {kind} 1.0\nelement vertex {counts[0]}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {counts[1]}\nproperty list uchar int vertex_indices\nend_header\n"
    return head.encode() + b"0 0 0\n" * 40


@pytest.mark.parametrize("counts", [(4_294_967_298, 1), (3, 4_294_967_296), (10**18, 1), (-1, 1), ("x", 1), (3, 100)])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_a_ply_that_announces_too_much(
    forked: Forked, make_scene: Make, tmp_path: Path, counts: tuple[object, object], kind: str
) -> None:
    path = make_scene()
    (tmp_path / "animal.ply").write_bytes(_ply(counts, kind))
    refused(forked.run("check", path), "scene.xml:8:", "body", "animal.ply")


def test_a_serialized_mesh_that_announces_too_much(forked: Forked, make_scene: Make, tmp_path: Path) -> None:
    body = struct.pack("<I", 0x1000) + b"m\0" + struct.pack("<QQ", 1 << 33, 1 << 31)
    (tmp_path / "m.serialized").write_bytes(struct.pack("<HH", 0x041C, 4) + zlib.compress(body + bytes(1000)))
    base = BASE.replace('"ply"', '"serialized"').replace("animal.ply", "m.serialized")
    refused(forked.run("check", make_scene(base=base)), "scene.xml:8:", "body", "announces")


@pytest.mark.parametrize(("cells", "value", "words"), [(9, 1.0, "announces"), (2, np.nan, "8 of 8 values")])
def test_a_volume_that_is_broken(
    forked: Forked, make_scene: Make, tmp_path: Path, cells: int, value: float, words: str
) -> None:
    head = b"VOL\x03" + struct.pack("<iiiii", 1, cells, 2, 2, 1) + struct.pack("<6f", 0, 0, 0, 1, 1, 1)
    (tmp_path / "v.vol").write_bytes(head + np.full(8, value, "<f4").tobytes())
    texture = '<texture type="volume" name="reflectance"><volume type="gridvolume" name="volume">'
    texture += '<string name="filename" value="v.vol"/></volume></texture>'
    outcome = forked.run("check", make_scene(part=f'<bsdf type="diffuse" id="part">{texture}</bsdf>'))
    refused(outcome, "scene.xml:9:", "gridvolume", "v.vol", words)


def test_a_measured_material_that_is_broken(forked: Forked, make_scene: Make, tmp_path: Path) -> None:
    field = struct.pack("<H", 5) + b"theta" + struct.pack("<HBQ", 1, 10, 1 << 40) + struct.pack("<Q", 8)
    (tmp_path / "m.bsdf").write_bytes(b"tensor_file\0\x01\0" + struct.pack("<I", 1) + field)
    part = '<bsdf type="measured" id="part"><string name="filename" value="m.bsdf"/></bsdf>'
    refused(forked.run("check", make_scene(part=part)), "scene.xml:9:", "part", "'theta'")


INSIDE = {
    "lamp": '<shape type="ply" id="lamp">{}<emitter type="area"/></shape>',
    "material's light": '<emitter type="area" id="a"/><shape type="ply" id="lamp">{}<ref id="a"/></shape>',
}


@pytest.mark.parametrize("where", INSIDE)
def test_an_index_out_of_range_anywhere(forked: Forked, make_scene: Make, tmp_path: Path, where: str) -> None:
    vertices, faces = unit_sphere(1)
    faces = faces.copy()
    faces[3, 1] = 10**7
    write_ply(tmp_path / "bad.ply", vertices, faces)
    path = make_scene(light=LIGHT + INSIDE[where].format('<string name="filename" value="bad.ply"/>'))
    refused(forked.run("check", path), "scene.xml:7:", "lamp", "bad.ply", "face 3", "out of range")


def test_usage_is_one_line(forked: Forked) -> None:
    outcome = forked.run("check")
    assert outcome.kind == USAGE and outcome.errors.count("\n") == 1
