"""How deep the objects of a scene are nested, references included."""

from __future__ import annotations

from collections.abc import Iterator

from fd_mitsuba.scene.xml_element import XmlElement

MAX_OBJECT_NESTING = 16
"""Nested objects that Mitsuba walks in exponential time, such as a `twosided` in a `twosided`, stay below this."""

_OBJECTS = frozenset(
    "scene bsdf emitter film integrator medium phase rfilter sampler sensor shape texture volume".split()
)


def is_object(element: XmlElement) -> bool:
    """Whether an element makes a plugin, and not a property of one."""
    return element.tag in _OBJECTS or (element.tag == "spectrum" and "type" in element.attributes)


def refuse_deep_objects(root: XmlElement) -> None:
    """Raise UserError where objects are nested deeper than `MAX_OBJECT_NESTING`, or refer to themselves.

    Mitsuba follows references by recursion: a chain of a hundred thousand would end the process.
    """
    named: dict[str, XmlElement] = {}
    for element in _all(root):
        if is_object(element) and element.attributes.get("id"):
            named.setdefault(element.attributes["id"], element)
        elif element.tag == "alias":
            source = named.get(element.attributes.get("id", ""))
            if source is not None:
                named.setdefault(element.attributes.get("as", ""), source)

    def below(element: XmlElement) -> Iterator[XmlElement]:
        for child in element.children:
            if is_object(child):
                yield child
            elif child.tag == "ref" and (target := named.get(child.attributes.get("id", ""))) is not None:
                yield target

    height: dict[int, int] = {}
    for start in root.children:
        if not is_object(start):
            continue
        # Depth first and without recursion; `path` is the way down from `start`.
        path = [(start, below(start))]
        on_path = {id(start)}
        while path:
            element, rest = path[-1]
            child = next(rest, None)
            if child is None:
                path.pop()
                on_path.discard(id(element))
                height[id(element)] = 1 + max((height[id(item)] for item in below(element)), default=0)
                if height[id(element)] > MAX_OBJECT_NESTING:
                    raise element.error(f"objects are nested deeper than {MAX_OBJECT_NESTING}; flatten them")
            elif id(child) in on_path:
                names = [item.attributes.get("id") or str(item) for item, _ in path]
                names = [*names[-3:], child.attributes.get("id") or str(child)]
                raise child.error(f"circular reference: {' -> '.join(names)}; break the circle of <ref> elements")
            elif id(child) not in height:
                path.append((child, below(child)))
                on_path.add(id(child))


def _all(root: XmlElement) -> Iterator[XmlElement]:
    waiting = [root]
    while waiting:
        element = waiting.pop()
        yield element
        waiting += reversed(element.children)
