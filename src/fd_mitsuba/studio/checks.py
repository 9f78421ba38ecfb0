"""The live check of a session: again whenever something has changed, in a thread of its own."""

from __future__ import annotations

import traceback
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from fd_mitsuba.errors import UserError
from fd_mitsuba.studio.debounce import Debounced
from fd_mitsuba.studio.live_check import LiveCheck, live_check

if TYPE_CHECKING:
    from fd_mitsuba.studio.session import Session


class Checks:
    """Asks for checks and keeps the newest.

    Attributes:
        newest: None: there is none yet.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self.newest: LiveCheck | None = None
        self._executor = ThreadPoolExecutor(1, "studio-work")
        self.soon = Debounced(self._in_turn, self._executor)

    def close(self) -> None:
        """End, when the present one has."""
        self.soon.close()
        self._executor.shutdown(wait=True, cancel_futures=True)

    def now(self) -> LiveCheck:
        """Check what there is, and remember it; the answer is out of date when something changes meanwhile."""
        session = self._session
        with session.lock:
            scene, config = session.state.edited_scene(), session.state.settings.config()
        with session.mitsuba:
            result = live_check(scene, config)
        with session.lock:
            self.newest = result
            session.save()
        session.tell("check")
        return result

    def _in_turn(self) -> None:
        try:
            self.now()
        except UserError as error:
            self._failed(str(error))
        except Exception:
            traceback.print_exc()
            self._failed("the check failed; the terminal has more about it")

    def _failed(self, why: str) -> None:
        self.newest = LiveCheck(why)
        self._session.tell("check")
