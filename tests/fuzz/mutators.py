"""Faults that are put into sound inputs, each by a random generator that was seeded for its case alone."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
from fuzz.plugin_values import plugin_values
from fuzz.seeds import obj_bytes, ply_bytes, serialized_bytes, sphere_arrays

NUMBERS = (
    "0 -1 1 2 0.5 1e-40 1e-300 1e38 1e39 1e300 1e999 nan -nan inf -inf 2147483647 2147483648 4294967295 4294967296 "
    "18446744073709551616 -9223372036854775808 1000000000 0x10 1,5 1e 1e+ +5 --1 1_000 ٣ ½"
).split()
WORDS = [
    "", " ", "$", "$x", "$words", "\\$", "..", "../../../etc/passwd", "/dev/zero", "/dev/null", ".", "scene.xml",
    "pipe", "more", "body.ply", "head.obj", "head.serialized", "sky.exr", "paint.png", "lamp.spd", "gone.ply", "CON",
    "a b/c:d",
    "\u202eltr", "\x9b31m", "é", "🦄", "x" * 5000, "%s%n", "{0}", "<b>&amp;", "'", '"', "true", "false", "base", "part",
    "wing", "body", "part_part", "cut_face_part", "none", "subtract", "add", "../../evil", "-1", "nan",
]  # fmt: skip
TAGS = (
    "scene shape bsdf emitter texture sensor film sampler integrator medium phase rfilter volume spectrum rgb float "
    "integer boolean string point vector transform translate rotate scale lookat matrix include default path ref alias"
).split()
NAMES = (
    "filename to_world radius center p0 p1 scale radiance intensity reflectance base_color roughness metallic alpha "
    "eta specular width height fov near_clip max_depth prompt part mode name id value weight nested_bsdf normalmap "
    "to_uv raw wrap_mode filter_type face_normals flip_normals shape_index material k samples_per_wavelength "
    "opacity spec_trans clearcoat sheen position irradiance direction cutoff_angle turbidity sun_scale grid data "
    "bitmap volume accel"
).split()
PLUGINS = (
    "area batch bitmap blackbody blendbsdf bsplinecurve bumpmap checkerboard circular conductor constant "
    "constvolume cube cylinder d65 dielectric diffuse directional directionalarea disk ellipsoids ellipsoidsmesh "
    "envmap gridvolume hair hdrfilm heterogeneous homogeneous independent instance irregular isotropic hg "
    "linearcurve mask measured merge mesh_attribute normalmap null obj orthographic perspective plastic ply point "
    "pplastic principled principledthin projector rawconstant rectangle regular roughconductor roughdielectric "
    "roughplastic sdfgrid serialized shapegroup specfilm sphere spot srgb sunsky thindielectric thinlens twosided "
    "uniform volume focal_region dual_path path aov"
).split()
SPECIALS = (np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-40, 1e20, 0.0, 3e9)

Mutator = Callable[[Random, Path], list[str]]
"""Takes the folder of the sound inputs, spoils them, and returns the arguments of the command."""


def spoiled(rng: Random, data: bytes) -> bytes:
    """Bytes with one to four faults: flipped, cut out, doubled, swapped, or replaced by what parsers trip over."""
    tokens = [
        b"\0",
        b"\xff",
        b"\xff\xfe",
        b"<",
        b">",
        b"&",
        b"&#0;",
        b"]]>",
        b"<!--",
        b"<![CDATA[",
        b"<?",
        b'"',
        b"'",
        b"\n",
    ]
    tokens += [number.encode() for number in NUMBERS]
    for _ in range(rng.randint(1, 4)):
        if not data:
            return data
        at = rng.randrange(len(data))
        length = min(len(data) - at, int(2 ** rng.uniform(0, 8)))
        kind = rng.randrange(7)
        if kind == 0:
            data = data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
        elif kind == 1:
            data = data[:at] + data[at + length :]
        elif kind == 2:
            data = data[:at] + data[at : at + length] * rng.choice([2, 3, 50]) + data[at + length :]
        elif kind == 3:
            data = data[:at]
        elif kind == 4:
            data = data[:at] + rng.choice(tokens) + data[at + rng.choice([0, 1, length]) :]
        elif kind == 5:
            data = data[:at] + rng.randbytes(min(length, 8)) + data[at + min(length, 8) :]
        else:
            numbers = [match.span() for match in re.finditer(rb"[-+]?\d+\.?\d*", data[:100_000])]
            if numbers:
                start, end = rng.choice(numbers)
                data = data[:start] + rng.choice(NUMBERS).encode() + data[end:]
    return data


def _check(folder: Path) -> list[str]:
    return ["check", str(folder / "scene.xml"), "-c", str(folder / "settings.toml")]


def scene_bytes(rng: Random, folder: Path) -> list[str]:
    """Faults in the bytes of the scene or of what it includes."""
    path = folder / rng.choice(["scene.xml", "scene.xml", "part.xml"])
    path.write_bytes(spoiled(rng, path.read_bytes()))
    return _check(folder)


def scene_elements(rng: Random, folder: Path) -> list[str]:
    """Well-formed, but elements are moved, renamed, doubled, retyped, or given other values."""
    import xml.etree.ElementTree as ET

    path = folder / rng.choice(["scene.xml", "scene.xml", "part.xml"])
    root = ET.fromstring(path.read_bytes())
    for _ in range(rng.randint(1, 4)):
        parents = [element for element in root.iter() if len(element)]
        parent = rng.choice(parents)
        child = rng.choice(list(parent))
        kind = rng.randrange(9)
        if kind == 0:
            parent.remove(child)
        elif kind == 1:
            parent.append(child)
        elif kind == 2:
            inside = {id(element) for element in child.iter()}
            homes = [element for element in root.iter() if id(element) not in inside]
            parent.remove(child)
            rng.choice(homes).append(child)
        elif kind == 3:
            child.tag = rng.choice(TAGS)
        elif kind == 4 and child.attrib:
            child.set(rng.choice(sorted(child.attrib)), rng.choice([*NUMBERS, *WORDS]))
        elif kind == 5:
            child.set("type", rng.choice(PLUGINS))
        elif kind == 6:
            child.set("name", rng.choice(NAMES))
        elif kind == 7:
            child.attrib.pop(rng.choice(sorted(child.attrib) or [""]), None)
        else:
            child.append(_property(rng))
    path.write_bytes(ET.tostring(root, encoding="utf-8"))
    return _check(folder)


def _property(rng: Random):
    import xml.etree.ElementTree as ET

    tag = rng.choice(
        ["float", "integer", "boolean", "string", "rgb", "spectrum", "point", "transform", "ref", "texture"]
    )
    element = ET.Element(tag, {"name": rng.choice(NAMES)})
    if tag == "point":
        element.attrib |= {axis: rng.choice(NUMBERS) for axis in "xyz"}
    elif tag == "transform":
        ET.SubElement(element, "matrix", {"value": " ".join(rng.choice(NUMBERS[:14]) for _ in range(16))})
    elif tag == "ref":
        element.set("id", rng.choice(["paint", "part", "sky", "body", "wing", "eye", "unused"]))
    elif tag == "texture":
        element.set("type", rng.choice(PLUGINS))
    elif tag == "string":
        element.set("value", rng.choice(WORDS))
    else:
        element.set("value", rng.choice([*NUMBERS, "true", "false", "0.1, 0.2, 0.3", "400:1, 500:2"]))
    return element


def plugins(rng: Random, folder: Path) -> list[str]:
    """A random plugin with random properties, some of them objects, anywhere in the scene."""
    import xml.etree.ElementTree as ET

    path = folder / "scene.xml"
    root = ET.fromstring(path.read_bytes())
    kinds = ["shape", "bsdf", "emitter", "texture", "sensor", "medium", "volume", "film", "integrator"]
    element = ET.Element(rng.choice(kinds), {"type": rng.choice(PLUGINS)})
    for _ in range(rng.randint(0, 4)):
        if rng.random() < 0.3:
            inner = ET.SubElement(element, rng.choice(kinds), {"type": rng.choice(PLUGINS)})
            if rng.random() < 0.5:
                inner.set("name", rng.choice(NAMES))
            inner.append(_property(rng))
        else:
            element.append(_property(rng))
    if rng.random() < 0.4:
        name = rng.choice(["body.ply", "head.obj", "sky.exr", "paint.png", "head.serialized", "lamp.spd"])
        ET.SubElement(element, "string", {"name": "filename", "value": name})
    parents = [root, root, *(item for item in root.iter() if item.tag in ("shape", "bsdf", "emitter"))]
    rng.choice(parents).append(element)
    path.write_bytes(ET.tostring(root, encoding="utf-8"))
    return _check(folder)


def mesh_bytes(rng: Random, folder: Path) -> list[str]:
    """Faults in the bytes of a mesh."""
    path = folder / rng.choice(["body.ply", "more/lamp.ply", "head.obj", "head.serialized"])
    if path.suffix == ".serialized":
        _use_serialized(folder)
    path.write_bytes(spoiled(rng, path.read_bytes()))
    return _check(folder)


def mesh_values(rng: Random, folder: Path) -> list[str]:
    """Well-formed meshes with numbers and indices that are not."""
    vertices, uv, faces = sphere_arrays()
    uv = uv.copy()
    for _ in range(rng.randint(1, 3)):
        kind = rng.randrange(6)
        if kind == 0:
            vertices[rng.randrange(len(vertices)), rng.randrange(3)] = rng.choice(SPECIALS)
        elif kind == 1:
            uv[rng.randrange(len(uv)), rng.randrange(2)] = rng.choice(SPECIALS)
        elif kind == 2:
            faces[rng.randrange(len(faces)), rng.randrange(3)] = rng.choice(
                [-1, -2, len(vertices), len(vertices) + 3, 10**6, 2**31 - 1, 0]
            )
        elif kind == 3:
            faces = faces[: rng.choice([0, 1, 2, len(faces) // 2])]
        elif kind == 4:
            vertices, uv = vertices[: rng.choice([0, 1, 3, 20])], uv[: rng.choice([0, 1, 3, 20])]
            uv = np.resize(uv, (len(vertices), 2))
        else:
            with np.errstate(invalid="ignore"):
                vertices *= rng.choice([0.0, 1e-30, 1e18, -1.0])
        if not len(faces) or not len(vertices):
            break
    kind = rng.choice(["body.ply", "body.ply", "more/lamp.ply", "head.obj", "head.serialized"])
    if kind.endswith("obj"):
        data = obj_bytes(vertices, uv, faces)
    elif kind.endswith("serialized"):
        _use_serialized(folder)
        data = serialized_bytes(vertices, faces)
    else:
        data = ply_bytes(vertices, uv, faces, binary=rng.random() < 0.5)
    (folder / kind).write_bytes(data)
    return _check(folder)


def _use_serialized(folder: Path) -> None:
    path = folder / "scene.xml"
    text = path.read_text().replace('"obj" id="head"', '"serialized" id="head"').replace("head.obj", "head.serialized")
    path.write_text(text)


def pictures(rng: Random, folder: Path) -> list[str]:
    """Faults in the bytes of a picture or a spectrum."""
    path = folder / rng.choice(["sky.exr", "sky.exr", "paint.png", "paint.jpg", "lamp.spd"])
    if path.suffix == ".exr" and rng.random() < 0.3:
        size = struct.pack("<ii", rng.choice([1, 100_000, 2**31 - 1]), 4)
        samples = [b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n" + bytes(128), b"GIF89a" + bytes(99)]
        samples += [
            b"PF\n8 4\n-1.0\n" + bytes(384),
            b"P6\n8 4\n255\n" + bytes(96),
            b"BM" + bytes(16) + size + bytes(99),
        ]
        path.write_bytes(rng.choice(samples))
    path.write_bytes(spoiled(rng, path.read_bytes()))
    return _check(folder)


def settings(rng: Random, folder: Path) -> list[str]:
    """Faults in the settings: bytes, values, and `--set`."""
    path = folder / "settings.toml"
    known = [f"{section}.{name}" for section, name in _settings()]
    if rng.random() < 0.5:
        path.write_bytes(spoiled(rng, path.read_bytes()))
        return _check(folder)
    arguments = _check(folder)
    for _ in range(rng.randint(1, 3)):
        key = rng.choice([*known, "seed", "geometry", "x.y.z", "", ".", "geometry.."])
        value = rng.choice(
            [*NUMBERS, *WORDS, "9" * 5000, "[" * 200, "[1, 2]", "[nan, 1]", "{a=1}", "1979-05-27", "'''"]
        )
        arguments += ["--set", f"{key}={value}".replace("\0", "")]
    return arguments


def _settings() -> list[tuple[str, str]]:
    from fd_mitsuba.config import RunConfig

    fields = RunConfig().model_dump()
    return [(section, name) for section, values in fields.items() if isinstance(values, dict) for name in values]


def arguments(rng: Random, folder: Path) -> list[str]:
    """Commands with arguments that are missing, doubled, of another kind, or name what is no file."""
    os.mkfifo(folder / "pipe")
    (folder / "odd \udce4\u202e.xml").write_bytes((folder / "scene.xml").read_bytes())
    places = [
        str(folder / name) for name in ("scene.xml", "settings.toml", "body.ply", "pipe", "gone", "more", "sky.exr")
    ]
    places += [
        "/dev/null",
        "/dev/zero",
        "",
        "/",
        str(folder),
        str(folder / "odd \udce4\u202e.xml"),
        "x" * 300,
        "-",
        "--",
    ]
    command = rng.choice(["check", "check", "check", "report", "export", "parts", "instance", "render", "no"])
    given = [command]
    if rng.random() < 0.8:
        given.append(str(folder / "scene.xml") if command == "check" and rng.random() < 0.6 else rng.choice(places))
    options = "-c --config --regions -D --prompt --set -t -m --json --help -o --format --texture-size --faces --title"
    options = [*options.split(), "--hide", "--views", "-x"]
    for _ in range(rng.randint(0, 3)):
        given.append(rng.choice(options))
        if rng.random() < 0.9:
            given.append(rng.choice([*places, *NUMBERS, *WORDS, "words=a cat", "size=nan", "seed=1", "a=\udce4"]))
    # What takes minutes or opens the network is not for here, nor what an option writes where it likes.
    unsafe = {"-o", "--gallery", "-m"}
    return [item for item, before in zip(given, ["", *given[:-1]], strict=True) if not {item, before} & unsafe]


def previews(rng: Random, folder: Path) -> list[str]:
    """Any of the faults of scenes and their files, in front of a command that renders."""
    rng.choice([scene_elements, plugin_values, plugin_values, mesh_values, pictures])(rng, folder)
    return ["preview", str(folder / "scene.xml"), "-o", str(folder / "preview")]


KINDS: dict[str, Mutator] = {
    "bytes of a scene": scene_bytes,
    "elements of a scene": scene_elements,
    "plugins": plugins,
    "values of plugins": plugin_values,
    "bytes of a mesh": mesh_bytes,
    "values of a mesh": mesh_values,
    "pictures": pictures,
    "settings": settings,
    "arguments": arguments,
}
"""The cheap kinds: a tenth of a second each."""
LONG_KINDS: dict[str, Mutator] = {"previews": previews}
