"""The garbage collector passes over what stays, and is the caller's again afterwards."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from fd_mitsuba.backend.collector import long_lived, uncollected


@pytest.fixture
def unfrozen() -> Iterator[None]:
    frozen = gc.get_freeze_count()
    gc.unfreeze()
    yield
    if frozen:
        gc.freeze()


class Ring:
    def __init__(self) -> None:
        self.me = self


@pytest.mark.usefixtures("unfrozen")
def test_rings_made_meanwhile_are_found_and_those_before_later() -> None:
    old = Ring()
    gone = weakref.ref(old)
    with long_lived():
        new = weakref.ref(Ring())
        del old
        gc.collect()
        assert new() is None and gone() is not None
    gc.collect()
    assert gone() is None and gc.get_freeze_count() == 0


@pytest.mark.usefixtures("unfrozen")
def test_what_somebody_else_has_frozen_stays_so() -> None:
    gc.freeze()
    count = gc.get_freeze_count()
    with long_lived():
        pass
    assert gc.get_freeze_count() == pytest.approx(count, rel=0.01)


@pytest.mark.parametrize("before", [True, False])
def test_the_collector_is_as_it_was(before: bool) -> None:
    was = gc.isenabled()
    (gc.enable if before else gc.disable)()
    try:
        with pytest.raises(KeyError), uncollected():
            assert not gc.isenabled()
            raise KeyError
        assert gc.isenabled() is before
    finally:
        (gc.enable if was else gc.disable)()
