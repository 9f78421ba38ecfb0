"""The text that Mitsuba parses: one element a line, so that a line in its messages is an element of the user's file."""

from __future__ import annotations

from dataclasses import dataclass

from fd_mitsuba.scene.object_nesting import is_object
from fd_mitsuba.scene.xml_element import XmlElement

_ESCAPED = str.maketrans(
    {"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;", "\t": "&#9;", "\n": "&#10;", "\r": "&#13;", "$": "\\$"}
)


@dataclass(frozen=True)
class NormalisedXml:
    """Text, and for each of its lines the element that starts there and the object that this belongs to."""

    text: str
    elements: tuple[XmlElement, ...]
    owners: tuple[XmlElement, ...]

    def place(self, line: int) -> tuple[str, str]:
        """File and line, and what stands there: the object, and in it the property if it is one."""
        if not 1 <= line <= len(self.elements):
            return "", ""
        element, owner = self.elements[line - 1], self.owners[line - 1]
        if owner.tag == "scene":
            return element.where, "" if element is owner else str(element)
        return element.where, str(element) if element is owner else f"{_short(owner)}: {element}"


def normalise(root: XmlElement) -> NormalisedXml:
    """The element and all below it as text; its depth is bounded, so that recursion is."""
    pieces: list[str] = []
    elements: list[XmlElement] = []
    owners: list[XmlElement] = []

    def write(element: XmlElement, owner: XmlElement) -> None:
        owner = element if is_object(element) else owner
        if elements:
            pieces.append("\n")
        elements.append(element)
        owners.append(owner)
        attributes = "".join(f' {key}="{value.translate(_ESCAPED)}"' for key, value in element.attributes.items())
        if not element.children:
            pieces.append(f"<{element.tag}{attributes}/>")
            return
        pieces.append(f"<{element.tag}{attributes}>")
        for child in element.children:
            write(child, owner)
        pieces.append(f"</{element.tag}>")

    write(root, root)
    return NormalisedXml("".join(pieces), tuple(elements), tuple(owners))


def _short(owner: XmlElement) -> str:
    name = owner.attributes.get("id")
    return f'<{owner.tag} type="{owner.attributes.get("type", "")}"' + (f' id="{name}">' if name else ">")
