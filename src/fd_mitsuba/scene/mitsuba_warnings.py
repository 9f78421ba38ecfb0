"""What Mitsuba warns of while it loads something, as lines for the user."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_ENTRY = re.compile(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d WARN\s+", re.MULTILINE)
_SOURCE = re.compile(r"^(?:[\w/]+\s+)?\[[^\]]*\]\s*(?:\w+:\s*)?")
_PICTURE_OF_OBJECT = re.compile(r"\s*:?\s*\w+\[\s*\n.*", re.DOTALL)
_LONGEST = 240
_ABOUT_SPEED = "performance warning"


@contextmanager
def mitsuba_warnings(mi: Any) -> Iterator[list[str]]:
    """A list that holds, once the block has ended, what Mitsuba warned of in it; each sentence once.

    They go through a file and not through a logger in Python: threads of Mitsuba would wait for the interpreter, and
    the interpreter for them. Where there is no room for a file, nothing is collected. Warnings about speed alone are
    left out.
    """
    found: list[str] = []
    logger = mi.logger()
    before = [logger.appender(number) for number in range(logger.appender_count())]
    level = logger.log_level()
    try:
        file = tempfile.NamedTemporaryFile(suffix=".log")
    except OSError:
        yield found
        return
    with file:
        collector = mi.StreamAppender(file.name)
        logger.clear_appenders()
        logger.add_appender(collector)
        logger.set_log_level(mi.LogLevel.Warn)
        try:
            yield found
        finally:
            logger.clear_appenders()
            for appender in before:
                logger.add_appender(appender)
            logger.set_log_level(level)
            del collector
            text = file.read().decode("utf-8", errors="replace")
    found += dict.fromkeys(warning_lines(text))


def warning_lines(text: str) -> list[str]:
    """Each warning of a log of Mitsuba as one line, without date, place in the source and printed objects."""
    lines = []
    for entry in _ENTRY.split(text)[1:]:
        line = " ".join(_PICTURE_OF_OBJECT.sub("", _SOURCE.sub("", entry)).split()).rstrip(" .:")
        if line and _ABOUT_SPEED not in line:
            lines.append(line if len(line) <= _LONGEST else line[:_LONGEST].rstrip() + " ...")
    return lines
