"""An XML file read strictly, by expat: no DOCTYPE, no entities, no attribute twice, no text, no deep nesting."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.regular_file import NotReadable, read_regular

MAX_NESTING = 100
MAX_BYTES = 1 << 26


@dataclass(slots=True)
class XmlElement:
    """One element and where it stands; attributes in the order of the file."""

    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    children: list[XmlElement] = field(default_factory=list)

    @property
    def where(self) -> str:
        """File and line, for messages."""
        return f"{self.file}:{self.line}"

    def __str__(self) -> str:
        shown = [f' {name}="{self.attributes[name]}"' for name in ("type", "name", "id") if self.attributes.get(name)]
        return f"<{self.tag}{''.join(shown)}>"

    def error(self, problem: str) -> UserError:
        """A UserError that names the file, the line and this element before `problem`."""
        return UserError(f"{self.where}: {self}: {problem}")


def read_xml(path: Path, limit: int = MAX_BYTES, root: str = "") -> tuple[XmlElement, int]:
    """The root element of a file and the file's size in bytes.

    Time and memory are proportional to the file.

    Args:
        limit: bytes that the file may have.
        root: the root element that is wanted, "" for any.

    Raises:
        UserError: no such file, not a regular file, too large, binary, empty, not well-formed, of unknown encoding or
            not in it, a DOCTYPE, text between elements, nesting deeper than `MAX_NESTING`.
    """
    data = _read(path, limit)
    reader = _Reader(path, root)
    try:
        reader.parser.Parse(data, True)
    except expat.ExpatError as error:
        raise reader.refusal(error, data) from None
    except (LookupError, ValueError) as error:  # an encoding that Python does not know either
        raise UserError(f"{path}:1: {error}; save the file as UTF-8") from None
    return reader.root, len(data)


class _Reader:
    def __init__(self, path: Path, root: str) -> None:
        self.path, self.wanted = path, root
        self.open: list[XmlElement] = []
        self.seen: list[XmlElement] = []
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.ordered_attributes = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._text
        self.parser.StartDoctypeDeclHandler = self._doctype

    @property
    def root(self) -> XmlElement:
        return self.seen[0]

    def refusal(self, error: expat.ExpatError, data: bytes) -> UserError:
        hint = 'write a Mitsuba scene, <scene version="3.0.0"> ... </scene>'
        if error.code == expat.errors.codes[expat.errors.XML_ERROR_NO_ELEMENTS] and not self.seen:
            return UserError(f"{self.path}: the file is empty; {hint}")
        if bad := _not_utf8(data):
            return UserError(f"{self.path}:{bad[0]}: holds a byte that is not UTF-8 (0x{bad[1]:02x}); save it as UTF-8")
        if not self.seen:
            return UserError(f"{self.path}: not an XML file ({expat.ErrorString(error.code)}); {hint}")
        text = f"not well-formed XML: {expat.ErrorString(error.code)}"
        return UserError(f"{self.path}:{error.lineno}: {text}; mend the XML there")

    def _start(self, tag: str, attributes: list[str]) -> None:
        pairs = dict(zip(attributes[::2], attributes[1::2], strict=True))
        element = XmlElement(tag, pairs, self.path, self.parser.CurrentLineNumber)
        if len(self.open) >= MAX_NESTING:
            raise element.error(f"is nested deeper than {MAX_NESTING} elements; flatten the scene")
        if self.open:
            self.open[-1].children.append(element)
        else:
            if self.wanted not in ("", tag):
                problem = f"the root element is <{tag}>; a scene file starts with <{self.wanted}>"
                raise UserError(f"{element.where}: {problem}")
            self.seen.append(element)
        self.open.append(element)

    def _end(self, tag: str) -> None:
        self.open.pop()

    def _text(self, text: str) -> None:
        if text.strip():
            line = self.parser.CurrentLineNumber
            shown = " ".join(text.split())[:40]
            place = f"{self.path}:{line}: text {shown!r} in {self.open[-1]}"
            raise UserError(f'{place}, where Mitsuba reads only attributes; remove it, or write value="..."')

    def _doctype(self, *_: object) -> None:
        line = self.parser.CurrentLineNumber
        raise UserError(f"{self.path}:{line}: <!DOCTYPE>: document types and entities are not read; remove it")


def _read(path: Path, limit: int) -> bytes:
    if path.is_dir():
        raise UserError(f"{path}: is a folder; give the scene file, such as {path / 'scene.xml'}")
    try:
        data = read_regular(path, limit)
    except NotReadable as error:
        problem = "no such scene file" if str(error) == "not found" else str(error)
        raise UserError(f"{path}: {problem}; give the path of a scene.xml") from None
    if b"\0" in data[:4096] and not data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise UserError(f"{path}: is a binary file, not XML; give the path of a scene.xml")
    return data


def _not_utf8(data: bytes) -> tuple[int, int] | None:
    """Line and value of the first byte that is not UTF-8, where the file does not say that it is something else."""
    declaration = data[:200].partition(b"?>")[0].lower()
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or (b"encoding" in declaration and b"utf-8" not in declaration):
        return None
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        return data.count(b"\n", 0, error.start) + 1, data[error.start]
    return None
