"""A scene file parsed by Mitsuba: its elements before any plugin runs, then the scene itself."""

from __future__ import annotations

import re
import sys
from bisect import bisect_right
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.backend import startup
from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.backend.parser_message import MITSUBA_ERRORS, one_line
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.safe_text import is_text
from fd_mitsuba.scene.centred import move_nodes, restore_digits
from fd_mitsuba.scene.file_faults import fault_of_file
from fd_mitsuba.scene.file_gate import check_meshes, opened_files, refuse_incomplete
from fd_mitsuba.scene.mesh_numbers import correct_mesh
from fd_mitsuba.scene.mitsuba_warnings import mitsuba_warnings
from fd_mitsuba.scene.normalised_xml import normalise
from fd_mitsuba.scene.plugins import register
from fd_mitsuba.scene.property_types import refuse_wrong_types
from fd_mitsuba.scene.scene_copy import copied_files
from fd_mitsuba.scene.xml_guard import scan_scene


def ready_mitsuba() -> Any:
    """The module `mitsuba` with a variant (the default one if none was chosen) and our plugins."""
    loaded = sys.modules.get("mitsuba")
    mi = loaded if loaded is not None and loaded.variant() is not None else startup.start()
    register(mi)
    return mi


@dataclass(frozen=True)
class SceneElement:
    """One object of the scene file with its plain properties.

    Attributes:
        kind: "shape", "bsdf", "integrator", "emitter", "texture", ... as the XML tag says.
        plugin: its type.
        id: its id, "" where it has none.
        top_level: whether it is a direct child of `<scene>`.
        where: file and line, for messages.
        properties: name -> value as Mitsuba parsed it.
        children: name -> position in `SceneFile.elements` of the objects that it holds or refers to.
    """

    kind: str
    plugin: str
    id: str
    top_level: bool
    where: str
    properties: dict[str, Any]
    children: dict[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        return _tag(self.kind, self.plugin, self.id)

    def error(self, problem: str) -> UserError:
        """A UserError that names the file, the line and this element before `problem`."""
        return UserError(f"{self.where}: {self}: {problem}")


def _tag(kind: str, plugin: str, name: str) -> str:
    return f'<{kind} type="{plugin}"' + (f' id="{name}">' if name else ">")


def _kind(node: Any) -> str:
    return str(node.type).rpartition(".")[2].lower()


class SceneFile:
    """A scene file and its `-D` parameters, checked and parsed but with nothing instantiated.

    Args:
        path: the XML file.
        parameters: values for `$name`; a `$` within a value is literal.

    Attributes:
        text: what the file says, names filled in and includes in place.
        elements: its objects, in file order.
        files: every file that it names, meshes, images, spectra and so on: name -> the file.
        warnings: of the last `instantiate`, a line each: what Mitsuba warned of, numbers of meshes that were mended.

    Raises:
        UserError: whatever `xml_guard.scan_scene` refuses; elements, properties or references that Mitsuba cannot read;
            a property of the wrong type; a file that the scene names, but that is missing or refused by `file_gate`.
    """

    def __init__(self, path: Path | str, parameters: dict[str, str] | None = None) -> None:
        self.path = Path(path)
        if not is_text(str(self.path.resolve())):
            raise UserError(
                f"{ascii(str(self.path.resolve()))}: Mitsuba reads no path that is not UTF-8 text; rename the folder"
            )
        self.parameters = dict(parameters or {})
        self.warnings: tuple[str, ...] = ()
        self._copied = copied_files(self.path)
        self.text = scan_scene(self.path, self.parameters)
        self._xml = normalise(self.text.root)
        self._line_starts = [0, *(match.end() for match in re.finditer(b"\n", self._xml.text.encode()))]
        self.mi = ready_mitsuba()
        self._resolver = self._own_resolver()
        with self.searching():
            self.elements = tuple(self._elements(self._parse()))
            refuse_incomplete(self.elements)
            self.files = self.text.spectra | opened_files(
                self.elements, self.mi.file_resolver(), self.path.parent, self._copied
            )

    def top_level(self, kind: str) -> list[SceneElement]:
        """The elements of one kind directly below `<scene>`, in file order."""
        return [element for element in self.elements if element.top_level and element.kind == kind]

    def instantiate(
        self,
        without: tuple[str, ...] = (),
        origin: np.ndarray | None = None,
        shapes: Collection[SceneElement] | None = None,
    ) -> Any:
        """The `mi.Scene`, with meshes and BSDFs kept apart (nothing merged) and ids as in the file.

        Args:
            without: top-level objects to leave out, by kind or plugin type, such as ("focal_region", "sensor").
            origin: (3,) the point of the file's frame that is at the scene's origin, for scenes that lie so far away
                that 32-bit floats show; None: the file's own.
            shapes: of the top-level shapes, those to keep; None: all.

        Raises:
            UserError: a mesh that would break Mitsuba; a plugin that fails, is unknown, or does not know a property.
        """
        with self.searching():
            check_meshes(self)
            state = self._parse()
            dropped = {i for i, item in enumerate(self.elements) if {item.kind, item.plugin} & set(without)}
            if shapes is not None:
                staying = {id(shape) for shape in shapes}  # by identity: two shapes may say the same
                dropped |= {
                    i for i, item in enumerate(self.elements) if item.kind == "shape" and id(item) not in staying
                }
            if dropped:
                self._drop(state, dropped)
            self._find_copies(state)
            if origin is not None and np.any(origin):
                root = state.root.props
                move_nodes(self.mi, [state.nodes[self._index(root, key)] for key in self._links(root)], origin)
            try:
                with file_threads(), mitsuba_warnings(self.mi) as said:
                    scene = self.mi.parser.instantiate(self._config(), state)
            except MITSUBA_ERRORS as error:
                raise (fault_of_file(self, error) or self.translated(error)) from None
            scene = scene[0] if isinstance(scene, list) else scene
            left = (item for i, item in enumerate(self.elements) if i not in dropped)
            kept = [item for item in left if item.top_level and item.kind == "shape"]
            loaded = scene.shapes() if kept else []
            # A plugin that makes several shapes of one, such as `merge`, leaves nothing to say which is whose.
            pairs = list(zip(kept, loaded, strict=True)) if len(kept) == len(loaded) else []
            if origin is not None and np.any(origin):
                restore_digits(self, scene, pairs, origin)
            numbers = [correct_mesh(self, element, shape) for element, shape in pairs]
            answered = tuple(start for item in numbers for start in item.answered)
            told = (f"{self.path}: Mitsuba: {line}" for line in said if not line.startswith(answered))
            self.warnings = (*told, *(line for item in numbers for line in item.warnings))
        return scene

    def description(self, element: SceneElement) -> dict[str, Any]:
        """The element and all below it as a dictionary for `mi.load_dict`, files with their full paths.

        Children without a name, such as the BSDF in a `twosided`, are called "nested_0" and so on.
        """
        found: dict[str, Any] = {"type": element.plugin, **element.properties}
        if isinstance(found.get("filename"), str):
            found["filename"] = str(self.resolve(found["filename"]).resolve())
        for name, position in element.children.items():
            found[name.replace("_arg_", "nested_")] = self.description(self.elements[position])
        return found

    def resolve(self, filename: str) -> Path:
        """The file that Mitsuba finds for a name in the scene: beside the scene first, then in its `<path>`s."""
        return self.files.get(filename, self.path.parent / filename)

    @contextmanager
    def searching(self) -> Iterator[None]:
        """While it lasts, Mitsuba looks for files beside the scene, then in its `<path>`s, then where it did before."""
        before = self.mi.file_resolver()
        self.mi.set_file_resolver(self._resolver)
        try:
            yield
        finally:
            self.mi.set_file_resolver(before)

    def translated(self, error: BaseException) -> UserError:
        """A RuntimeError of Mitsuba as one line about this scene."""
        return UserError(one_line(error, self.path, self._xml.place, self.mi))

    def _own_resolver(self) -> Any:
        resolver = self.mi.FileResolver()
        resolver.clear()
        for folder in (*self.text.paths, self.path.resolve().parent):
            resolver.append(str(folder))
        for entry in self.mi.file_resolver():
            resolver.append(entry)
        return resolver

    def _config(self) -> Any:
        config = self.mi.parser.ParserConfig(self.mi.variant())
        config.merge_meshes = False
        config.merge_equivalent = False
        # In parallel, the thread that fails first decides the message; and Python plugins gain nothing.
        config.parallel = False
        return config

    def _parse(self) -> Any:
        parser = self.mi.parser
        config = self._config()
        try:
            state = parser.parse_string(config, self._xml.text)
            parser.transform_all(config, state)
        except MITSUBA_ERRORS as error:
            raise self.translated(error) from None
        return state

    def _elements(self, state: Any) -> Iterator[SceneElement]:
        types = self.mi.Properties.Type
        children = {self._index(state.root.props, key) for key in self._links(state.root.props)}
        for number, node in enumerate(state.nodes):
            if number == 0:
                continue
            links = (types.Reference, types.ResolvedReference, types.Object)
            plain = [key for key in node.props.keys() if node.props.type(key) not in links]
            element = SceneElement(
                kind=_kind(node),
                plugin=node.props.plugin_name(),
                id=node.props.id(),
                top_level=number in children,
                where=self._xml.place(bisect_right(self._line_starts, node.offset))[0] or str(self.path),
                properties={key: node.props[key] for key in plain},
                # Node 0 is the scene itself, which is no element.
                children={key: self._index(node.props, key) - 1 for key in self._links(node.props)},
            )
            refuse_wrong_types(element, {key: node.props.type(key) for key in node.props.keys()}, types)
            yield element

    def _links(self, properties: Any) -> list[str]:
        resolved = self.mi.Properties.Type.ResolvedReference
        return [key for key in properties.keys() if properties.type(key) == resolved]

    def _index(self, properties: Any, key: str) -> int:
        return properties[key].index()

    def _find_copies(self, state: Any) -> None:
        """Let Mitsuba read what a copied scene keeps in another place than the name says."""
        for node in state.nodes if self._copied else ():
            name = node.props["filename"] if "filename" in node.props else None
            if isinstance(name, str) and name in self._copied:
                node.props["filename"] = str(self._copied[name])

    def _drop(self, state: Any, dropped: Collection[int]) -> None:
        """Take elements at these positions out of the scene, where they are directly below it."""
        root = state.root.props
        for key in self._links(root):
            if self._index(root, key) - 1 in dropped:  # node 0 is the scene itself, which is no element
                del root[key]
