"""Threads that Mitsuba needs while it reads files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def file_threads() -> Iterator[None]:
    """At least two Dr.Jit threads while it lasts: with one, Mitsuba 3.9 waits forever when it reads an EXR."""
    import drjit as dr

    threads = dr.thread_count()
    if threads < 2:
        dr.set_thread_count(2)
    try:
        yield
    finally:
        if threads < 2:
            dr.set_thread_count(threads)
