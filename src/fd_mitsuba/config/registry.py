"""Registries: what settings and scenes can name, from this package and others, each with typed settings of its own.

An entry is called with its settings and whatever its registry's users add:

    GEOMETRY_LOSSES: Registry[type[FieldLoss]] = Registry("geometry_losses", "geometry loss")

    @GEOMETRY_LOSSES.register("thin", ThinSettings)
    class Thin(FieldLoss): ...

    loss = GEOMETRY_LOSSES.make(Choice.of("thin", {"depth": 0.1}), "geometry.losses.thin")

Another package adds one by an entry point in the group `fd_mitsuba.<kind>`, named as the entry is and leading to the
module that registers it; a script by `load_plugins`. Either way its code runs with all rights of the process.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib
import importlib.util
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import ValidationError

from fd_mitsuba.config.choice import Choice
from fd_mitsuba.config.section import Section
from fd_mitsuba.config.toml_reading import first_problem
from fd_mitsuba.errors import UserError

T = TypeVar("T", bound=Callable[..., Any])
_NAME = re.compile(r"[a-z][a-z0-9_]*")


class NoSettings(Section):
    """Of an entry that has none."""


@dataclass(frozen=True)
class Entry(Generic[T]):
    """One thing that can be named.

    Attributes:
        name: as users write it.
        settings: model of its own settings; every field has a default.
        make: called with the settings first.
    """

    name: str
    settings: type[Section]
    make: T


class Registry(Generic[T]):
    """Entries of one kind by name.

    Args:
        kind: of the entry points' group, such as `variants`.
        label: in messages, such as `guidance variant`.
    """

    def __init__(self, kind: str, label: str) -> None:
        self.kind, self.label = kind, label
        self._entries: dict[str, Entry[T]] = {}

    def register(self, name: str, settings: type[Section] = NoSettings) -> Callable[[T], T]:
        """A decorator that adds a function or class under `name`.

        Raises:
            UserError: a name that is no lower-case identifier, or is taken; settings without defaults.
        """
        if not _NAME.fullmatch(name):
            raise UserError(f"{self.label} {name!r}: names are lower-case letters, digits and _; rename it")
        try:
            settings()
        except ValidationError as error:
            problem = first_problem(error, settings)
            raise UserError(f"{self.label} {name!r}: its settings lack a default ({problem})") from None

        def add(make: T) -> T:
            known = self._entries.get(name)
            # A notebook's cell that is run again defines the same thing anew.
            if known is not None and _place(known.make) != _place(make):
                raise UserError(f"{self.label} {name!r}: is taken by {_place(known.make)}; choose another name")
            self._entries[name] = Entry(name, settings, make)
            return make

        return add

    def names(self) -> tuple[str, ...]:
        """All names, those of installed packages too, which are not loaded for it."""
        return tuple(dict.fromkeys([*self._entries, *sorted(self._entry_points())]))

    def entry(self, name: str, where: str) -> Entry[T]:
        """The entry called `name`.

        Args:
            where: the key that names it, for the message.

        Raises:
            UserError: there is none, or the package that has it cannot be loaded.
        """
        if name not in self._entries and name in (found := self._entry_points()):
            self._load(found[name])
        if name not in self._entries:
            near = difflib.get_close_matches(name, self.names(), n=3, cutoff=0.4)
            hint = f"nearest: {', '.join(near)}; " if near else ""
            raise UserError(
                f"{where}: unknown {self.label} {name!r}; {hint}known: {', '.join(self.names())}; one of your own "
                "needs --plugin MODULE, or plugins in the settings"
            )
        return self._entries[name]

    def settings(self, choice: Choice, where: str) -> Section:
        """The entry's settings, checked, with defaults for what was not given; UserError that names the key."""
        entry = self.entry(choice.kind, where)
        try:
            return entry.settings.model_validate(choice.options)
        except ValidationError as error:
            raise UserError(f"{where} ({choice.kind}): {first_problem(error, entry.settings)}") from None

    def completed(self, choice: Choice, where: str) -> Choice:
        """The choice with all of its options; UserError as `settings`."""
        return Choice.of(choice.kind, self.settings(choice, where).model_dump(mode="json"))

    def make(self, choice: Choice, where: str, *context: Any) -> Any:
        """What the entry makes of its settings and the context; UserError as `settings`."""
        return self.entry(choice.kind, where).make(self.settings(choice, where), *context)

    def _entry_points(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=f"fd_mitsuba.{self.kind}")}

    def _load(self, point: EntryPoint) -> None:
        package = point.dist.name if point.dist is not None else point.value
        try:
            point.load()
        except UserError:
            raise
        except Exception as error:
            raise UserError(
                f"{self.label} {point.name!r}: its package {package} cannot be loaded ({_told(error)}); reinstall it"
            ) from error
        if point.name not in self._entries:
            raise UserError(
                f"{self.label} {point.name!r}: {point.value} of package {package} does not register it; update it"
            )


def load_plugins(modules: Iterable[str]) -> None:
    """Import modules that register entries: by their dotted names, or Python files by a path that ends in `.py`.

    Their code runs with all rights of this process: name only modules that you trust. Run folders are never asked.

    Raises:
        UserError: no such module or file, or it fails while it is imported.
    """
    for module in modules:
        try:
            if module.endswith(".py"):
                _import_file(Path(module))
            else:
                importlib.import_module(module)
        except UserError:
            raise
        except Exception as error:
            raise UserError(
                f"plugin {module}: cannot be imported ({_told(error)}); give a module on Python's path, or a .py file"
            ) from error


def _import_file(path: Path) -> None:
    if not path.is_file():
        raise UserError(f"plugin {path}: no such file; correct the path")
    path = path.resolve()
    name = f"fd_mitsuba_plugin_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}_{path.stem}"
    if name in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None  # the name ends in .py
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise


def _place(make: Callable[..., Any]) -> str:
    return f"{getattr(make, '__module__', '?')}.{getattr(make, '__qualname__', make)}"


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
