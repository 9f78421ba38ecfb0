"""What the panels of the page share: buttons and fields that call the page's actions by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


class ActionPanel:
    """Base of a panel.

    Args:
        gui: viser's, of the page.
        heard: wraps a handler: it is called with the event only where a client caused it, and errors are shown there.
        actions: name -> what a button does with the event; see `view`.
    """

    def __init__(
        self,
        gui: Any,
        heard: Callable[[Callable[[Any], object]], Callable[[Any], None]],
        actions: Mapping[str, Callable[[Any], object]],
    ) -> None:
        self._gui, self._heard, self._actions = gui, heard, actions

    def _button(self, label: str, action: str, **options: Any) -> Any:
        button = self._gui.add_button(label, **options)
        button.on_click(self._do(action))
        return button

    def _do(self, action: str) -> Callable[[Any], None]:
        return self._heard(lambda event: self._actions[action](event))
