"""Where the elements of an XML file stand in its bytes, so that one can be changed and all else kept as it is."""

from __future__ import annotations

from dataclasses import dataclass, field
from xml.parsers import expat

from fd_mitsuba.errors import UserError


@dataclass
class Span:
    """An element, and the bytes `[start, end)` that it takes; `[start, head)` is its first tag.

    `closed` is whether that tag is all there is, as in `<a/>`.
    """

    tag: str
    attributes: dict[str, str]
    start: int
    head: int
    end: int
    closed: bool
    children: list[Span] = field(default_factory=list)

    def child(self, tag: str, name: str) -> Span | None:
        """The child of that tag with that `name`; None where there is none."""
        found = (c for c in self.children if c.tag == tag and c.attributes.get("name") == name)
        return next(found, None)


def spans_of(data: bytes, name: str) -> Span:
    """The root element of an XML file in UTF-8.

    Raises:
        UserError: not well-formed, or of another encoding, which cannot be patched byte by byte.
    """
    declaration = data[:200].partition(b"?>")[0].lower()
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or (b"encoding" in declaration and b"utf-8" not in declaration):
        raise UserError(f"{name}: is not UTF-8; save it as UTF-8, and the studio can change it")
    top = Span("", {}, 0, 0, len(data), False)
    stack = [top]
    parser = expat.ParserCreate("utf-8")

    def opened(tag: str, attributes: dict[str, str]) -> None:
        start = parser.CurrentByteIndex
        head = _tag_end(data, start)
        span = Span(tag, attributes, start, head, head, data[head - 2 : head] == b"/>")
        stack[-1].children.append(span)
        stack.append(span)

    def ended(tag: str) -> None:
        span = stack.pop()
        if not span.closed:
            span.end = data.index(b">", parser.CurrentByteIndex) + 1

    parser.StartElementHandler, parser.EndElementHandler = opened, ended
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise UserError(f"{name}:{error.lineno}: not well-formed XML; mend it there") from None
    return top.children[0]


def _tag_end(data: bytes, start: int) -> int:
    """Behind the `>` of the tag that begins at `start`; a `>` in an attribute's quotes is none."""
    quote, at = 0, start
    while True:
        byte = data[at]
        if quote:
            quote = 0 if byte == quote else quote
        elif byte in b"\"'":
            quote = byte
        elif byte == ord(">"):
            return at + 1
        at += 1


def line_of(data: bytes, span: Span) -> tuple[int, int]:
    """The bytes to take away with an element: its whole line or lines where nothing else stands there."""
    start, end = span.start, span.end
    while start > 0 and data[start - 1] in b" \t":
        start -= 1
    behind = end
    while behind < len(data) and data[behind] in b" \t\r":
        behind += 1
    if (start == 0 or data[start - 1] == 10) and behind < len(data) and data[behind] == 10:
        return start, behind + 1
    return span.start, span.end


def indent_of(data: bytes, span: Span) -> str:
    """The blanks before an element that is the first thing on its line; "" for any other."""
    start = data.rfind(b"\n", 0, span.start) + 1
    blanks = data[start : span.start]
    return blanks.decode() if not blanks.strip(b" \t") else ""
