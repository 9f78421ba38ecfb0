"""Regions and prompt written into a scene file, with every other byte of it kept: comments, order, blanks, `$names`."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from xml.sax.saxutils import quoteattr

import numpy as np

from fd_mitsuba.conventions import DEFAULT_PART_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.focal_region import ADD
from fd_mitsuba.scene.plugins import DUAL_PATH, FOCAL_REGION
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose
from fd_mitsuba.studio.xml_spans import Span, indent_of, line_of, spans_of

Edit = tuple[int, int, bytes]
"""Bytes from, bytes up to, what takes their place."""


def patched(
    data: bytes,
    name: str,
    regions: Sequence[EllipsoidPose],
    before: Sequence[EllipsoidPose],
    kept: Collection[str] = (),
    prompt: str | None = None,
    base_prompt: str = "",
) -> bytes:
    """The scene file with these ellipsoids as its focal regions.

    Args:
        data: the file.
        name: of the file, for messages.
        regions: the ellipsoids to be there; those of the file that are not among them, by name, go.
        before: the ellipsoids as the file has them: one that is equal stays as it is written.
        kept: names of regions that stay whatever they are, such as meshes.
        prompt: None: stays.
        base_prompt: written where the file has no `dual_path` integrator yet.

    Raises:
        UserError: the regions do not stand in this file, but in an include; the file is not UTF-8.
    """
    root = spans_of(data, name)
    there = region_spans(root)
    known = {pose.name: pose for pose in before}
    missing = [title for title in [*known, *kept] if title not in there]
    if missing:
        raise UserError(f"{name}: region {missing[0]} does not stand in this file; write it there instead of including")
    edits: list[Edit] = []
    wanted = {pose.name: pose for pose in regions}
    for title, span in there.items():
        if title in kept:
            continue
        if title not in wanted:
            edits.append((*line_of(data, span), b""))
        elif wanted[title] != known.get(title):
            edits += _changed(data, span, wanted[title], known.get(title))
    new = [pose for pose in regions if pose.name not in there]
    if new:
        gone = [span for title, span in there.items() if title not in kept and title not in wanted]
        edits.append(_added(data, root, [span for span in root.children if span not in gone], new))
    if prompt is not None:
        edits += _prompt(data, root, prompt, base_prompt)
    for start, end, text in sorted(edits, reverse=True):
        data = data[:start] + text + data[end:]
    spans_of(data, name)
    return data


def region_spans(root: Span) -> dict[str, Span]:
    """Name -> element, of the focal regions that stand right below `<scene>`; names as `load_scene` gives them."""
    found = [s for s in root.children if s.tag == "shape" and s.attributes.get("type") == FOCAL_REGION]
    return {span.attributes.get("id") or f"region_{index + 1}": span for index, span in enumerate(found)}


def transform_lines(pose: EllipsoidPose) -> list[str]:
    """The lines of `<transform name="to_world">` for an ellipsoid: scale, rotate, translate."""
    (rx, ry, rz), (x, y, z) = map(_short, pose.radii), map(_short, pose.centre)
    lines = ['<transform name="to_world">', f'  <scale x="{rx}" y="{ry}" z="{rz}"/>']
    w = min(pose.wxyz[0], 1.0)
    angle = 2 * np.degrees(np.arctan2(np.linalg.norm(pose.wxyz[1:]), w))
    if angle > 1e-4:
        ax, ay, az = (_short(v) for v in np.array(pose.wxyz[1:]) / np.linalg.norm(pose.wxyz[1:]))
        lines.append(f'  <rotate x="{ax}" y="{ay}" z="{az}" angle="{_short(angle)}"/>')
    return [*lines, f'  <translate x="{x}" y="{y}" z="{z}"/>', "</transform>"]


def _changed(data: bytes, span: Span, pose: EllipsoidPose, before: EllipsoidPose | None) -> list[Edit]:
    indent = indent_of(data, span)
    if span.closed:
        return [(span.start, span.end, _shape(pose, indent, span.attributes))]
    edits: list[Edit] = []
    if before is None or (pose.centre, pose.wxyz, pose.radii) != (before.centre, before.wxyz, before.radii):
        place = span.child("transform", "to_world")
        inner = f"{indent}  " if place is None else indent_of(data, place) or f"{indent}  "
        text = f"\n{inner}".join(transform_lines(pose)).encode()
        if place is None:
            edits.append((span.head, span.head, f"\n{inner}".encode() + text))
        else:
            edits.append((place.start, place.end, text))
    known = {} if before is None else dict(_texts(before))
    for name, text in _texts(pose):
        if before is not None and known[name] == text:
            continue
        old = span.child("string", name)
        element = f'<string name="{name}" value={_attribute(text)}/>'.encode()
        if old is not None and text:
            edits.append((old.start, old.end, element))
        elif old is not None:
            edits.append((*line_of(data, old), b""))
        elif text and (name, text) != ("part", DEFAULT_PART_NAME):
            edits.append((span.head, span.head, f"\n{indent}  ".encode() + element))
    return edits


def _texts(pose: EllipsoidPose) -> list[tuple[str, str]]:
    """Name and value of the texts of a region that can be changed; blank: not written."""
    return [("part", pose.part), ("prompt", pose.prompt), ("negative_prompt", pose.negative_prompt)]


def _shape(pose: EllipsoidPose, indent: str, attributes: dict[str, str] | None = None) -> bytes:
    named = {"type": FOCAL_REGION, "id": pose.name, **(attributes or {})}
    lines = ["<shape " + " ".join(f"{key}={quoteattr(value)}" for key, value in named.items()) + ">"]
    for name, text in _texts(pose):
        if text and (name, text) != ("part", DEFAULT_PART_NAME):
            lines.append(f'  <string name="{name}" value={_attribute(text)}/>')
    if pose.mode != ADD:
        lines.append(f'  <string name="mode" value={quoteattr(pose.mode)}/>')
    lines += [f"  {line}" for line in transform_lines(pose)] + ["</shape>"]
    return f"\n{indent}".join(lines).encode()


def _added(data: bytes, root: Span, there: list[Span], new: list[EllipsoidPose]) -> Edit:
    """Behind the last region of those elements that stay, else behind the last of them."""
    regions = [span for span in there if span.attributes.get("type") == FOCAL_REGION]
    near = (regions or there or [None])[-1]
    if near is None:
        text = b"".join(b"\n  " + _shape(pose, "  ") for pose in new) + b"\n"
        if root.closed:
            return root.start, root.end, data[root.start : root.head - 2].rstrip() + b">" + text + b"</scene>"
        return root.head, root.head, text
    indent = indent_of(data, near) or "  "
    return near.end, near.end, b"".join(f"\n{indent}".encode() + _shape(pose, indent) for pose in new)


def _prompt(data: bytes, root: Span, prompt: str, base_prompt: str) -> list[Edit]:
    value = _attribute(prompt)
    element = f'<string name="prompt" value={value}/>'
    integrators = [span for span in root.children if span.tag == "integrator"]
    own = next((span for span in integrators if span.attributes.get("type") == DUAL_PATH), None)
    if own is None:
        about = f'<string name="base_prompt" value={_attribute(base_prompt)}/>' if base_prompt else ""
        whole = f'<integrator type="{DUAL_PATH}">{element}{about}</integrator>'.encode()
        if integrators:  # a scene has one integrator
            return [(integrators[0].start, integrators[0].end, whole)]
        return [(root.head, root.head, b"\n  " + whole)]
    old = own.child("string", "prompt")
    if old is None:
        if own.closed:
            whole = f'<integrator type="{DUAL_PATH}">{element}</integrator>'.encode()
            return [(own.start, own.end, whole)]
        return [(own.head, own.head, f"\n{indent_of(data, own)}  {element}".encode())]
    parameter = re.fullmatch(r"\$(\w+)", old.attributes.get("value", ""))
    if parameter is not None:
        for span in root.children:
            if span.tag == "default" and span.attributes.get("name") == parameter[1]:
                if span.attributes.get("value") == prompt:
                    return []
                return [(span.start, span.end, f'<default name="{parameter[1]}" value={value}/>'.encode())]
    return [] if old.attributes.get("value") == prompt else [(old.start, old.end, element.encode())]


def _attribute(text: str) -> str:
    """Text as an attribute's value; a `$` in it would be a parameter to whoever reads the scene."""
    return quoteattr(text.replace("$", "\\$"))


def _short(value: float) -> str:
    """Nine digits: more than a 32-bit float holds."""
    text = f"{float(value):.9g}"
    return "0" if text in ("-0", "0") or abs(float(value)) < 1e-12 else text
