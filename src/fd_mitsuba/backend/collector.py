"""Python's garbage collector, kept from searching what is known to stay: modules, classes, networks."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """No search for garbage while open: for imports, whose hundred thousand objects all stay. A fifth of their time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


@contextmanager
def long_lived() -> Iterator[None]:
    """What is there when it opens is passed over by searches for garbage until it closes.

    Libraries ask for whole searches, such as imageio after each video: 0.2 s each with torch and Diffusers loaded, and
    nothing with those passed over. Where somebody else has frozen objects already, it stays at that.
    """
    free = gc.get_freeze_count() == 0
    if free:
        gc.collect()
        gc.freeze()
    try:
        yield
    finally:
        if free:
            gc.unfreeze()
