"""A scene file parsed by Mitsuba: its elements before any plugin runs, then the scene itself."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fd_mitsuba.backend import startup
from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.backend.parser_message import one_line
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.file_faults import fault_of_file
from fd_mitsuba.scene.mesh_numbers import correct_mesh
from fd_mitsuba.scene.mitsuba_warnings import mitsuba_warnings
from fd_mitsuba.scene.plugins import register
from fd_mitsuba.scene.scene_copy import copied_files
from fd_mitsuba.scene.xml_guard import refuse_plugin_path, scan_scene

MAX_OBJECT_NESTING = 16
"""Nested objects that Mitsuba walks in exponential time, such as a `twosided` in a `twosided`, stay below this."""


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
        warnings: of the last `instantiate`, a line each: what Mitsuba warned of, numbers of meshes that were mended.

    Raises:
        UserError: whatever `xml_guard.scan_scene` refuses; XML or references that Mitsuba cannot read; an undefined
            `$name`; a plugin type that is a path; objects nested too deep; a file that the scene names but that is
            not there.
    """

    def __init__(self, path: Path | str, parameters: dict[str, str] | None = None) -> None:
        self.path = Path(path)
        self.parameters = dict(parameters or {})
        self.warnings: tuple[str, ...] = ()
        self.text = scan_scene(self.path, self.parameters)
        self.mi = ready_mitsuba()
        self._copied = copied_files(self.path)
        self._described: dict[tuple[int, int], str] = {}
        self._resolver = self._own_resolver()
        with self.searching():
            state = self._parse()
            self._resolver = self.mi.file_resolver()  # parsing a <path> adds to it
            self.elements = tuple(self._elements(state))
            self._refuse_deep_nesting(state)
            self.files = self._referenced_files()

    def top_level(self, kind: str) -> list[SceneElement]:
        """The elements of one kind directly below `<scene>`, in file order."""
        return [element for element in self.elements if element.top_level and element.kind == kind]

    def instantiate(self, without: tuple[str, ...] = ()) -> Any:
        """The `mi.Scene`, with meshes and BSDFs kept apart (nothing merged) and ids as in the file.

        Args:
            without: top-level objects to leave out, by kind or plugin type, such as ("focal_region", "sensor").

        Raises:
            UserError: a plugin that fails, is unknown, or does not know a property.
        """
        with self.searching():
            state = self._parse()
            if without:
                self._drop(state, without)
            self._find_copies(state)
            try:
                with file_threads(), mitsuba_warnings(self.mi) as said:
                    scene = self.mi.parser.instantiate(self._config(), state)
            except RuntimeError as error:
                raise (fault_of_file(self, error) or self.translated(error)) from None
            scene = scene[0] if isinstance(scene, list) else scene
            kept = [shape for shape in self.top_level("shape") if not {shape.kind, shape.plugin} & set(without)]
            shapes = scene.shapes() if kept else []
            # A plugin that makes several shapes of one, such as `merge`, leaves nothing to say which is whose.
            pairs = zip(kept, shapes, strict=True) if len(kept) == len(shapes) else ()
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
        return UserError(one_line(error, self.path, self._describe, self.mi))

    def _own_resolver(self) -> Any:
        resolver = self.mi.FileResolver()
        resolver.clear()
        resolver.append(str(self.path.resolve().parent))
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
        literal = {name: value.replace("$", "\\$") for name, value in self.parameters.items()}
        config = self._config()
        try:
            state = parser.parse_file(config, str(self.path), **literal)
            for node in state.nodes:
                file, line, column = self._location(state, node)
                if file == str(self.path):
                    self._described[line, column] = _tag(_kind(node), node.props.plugin_name(), node.props.id())
            parser.transform_all(config, state)
        except RuntimeError as error:
            raise self.translated(error) from None
        return state

    def _elements(self, state: Any) -> Iterator[SceneElement]:
        folder = self.path.resolve().parent
        for file in state.files:
            if not Path(str(file)).resolve().is_relative_to(folder):
                raise UserError(f"{self.path}: <include>: {file} lies outside the scene's folder; move it there")
        types = self.mi.Properties.Type
        children = {self._index(state.root.props, key) for key in self._links(state.root.props)}
        for number, node in enumerate(state.nodes):
            if number == 0:
                continue
            file, line, _ = self._location(state, node)
            links = (types.Reference, types.ResolvedReference, types.Object)
            properties = {key: node.props[key] for key in node.props.keys() if node.props.type(key) not in links}
            element = SceneElement(
                kind=_kind(node),
                plugin=node.props.plugin_name(),
                id=node.props.id(),
                top_level=number in children,
                where=f"{file or self.path}:{line}",
                properties=properties,
                # Node 0 is the scene itself, which is no element.
                children={key: self._index(node.props, key) - 1 for key in self._links(node.props)},
            )
            refuse_plugin_path(f"{element.where}: <{element.kind}>", element.plugin)
            yield element

    def _location(self, state: Any, node: Any) -> tuple[str, int, int]:
        file, _, rest = self.mi.parser.file_location(state, node).rpartition(" (line ")
        line, _, column = rest.rstrip(")").partition(", col ")
        return (file, int(line), int(column)) if column else (str(self.path), 0, 0)

    def _describe(self, line: int, column: int) -> str:
        return self._described.get((line, column), "")

    def _links(self, properties: Any) -> list[str]:
        resolved = self.mi.Properties.Type.ResolvedReference
        return [key for key in properties.keys() if properties.type(key) == resolved]

    def _index(self, properties: Any, key: str) -> int:
        return properties[key].index()

    def _refuse_deep_nesting(self, state: Any) -> None:
        depth: dict[int, int] = {}

        def depth_of(number: int) -> int:
            if number not in depth:
                properties = state.nodes[number].props
                below = [depth_of(self._index(properties, key)) for key in self._links(properties)]
                depth[number] = 1 + max(below, default=0)
            return depth[number]

        for number, element in enumerate(self.elements, start=1):
            if depth_of(number) > MAX_OBJECT_NESTING:
                raise element.error(f"objects are nested deeper than {MAX_OBJECT_NESTING}; flatten them")

    def _referenced_files(self) -> dict[str, Path]:
        files = {}
        resolver = self.mi.file_resolver()
        for element in self.elements:
            name = element.properties.get("filename")
            if not isinstance(name, str):
                continue
            target = self._copied.get(name) or Path(str(resolver.resolve(name)))
            if not target.is_file():
                kind = "is a folder" if target.is_dir() else f"not found (looked in {self.path.parent})"
                raise element.error(f"file {name!r} {kind}; correct the file name")
            files[name] = target
        return files

    def _find_copies(self, state: Any) -> None:
        """Let Mitsuba read what a copied scene keeps in another place than the name says."""
        for node in state.nodes if self._copied else ():
            name = node.props["filename"] if "filename" in node.props else None
            if isinstance(name, str) and name in self._copied:
                node.props["filename"] = str(self._copied[name])

    def _drop(self, state: Any, without: tuple[str, ...]) -> None:
        root = state.root.props
        for key in self._links(root):
            node = state.nodes[self._index(root, key)]
            if {_kind(node), node.props.plugin_name()} & set(without):
                del root[key]
