"""A hundred and sixty spoiled inputs: each works, is refused in one line that says where, or gets a usage message."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzz.forked import HANG, OTHER, REFUSED, SIGNAL, TRACEBACK, USAGE, WORKS, Forked, Outcome
from fuzz.fuzzer import ASSETS, Fuzzer, table
from fuzz.mutators import KINDS
from fuzz.seeds import small_exr, write_seeds

SEED = 20
CASES_A_KIND = 16


@pytest.fixture(scope="module")
def fuzzer() -> Iterator[Fuzzer]:
    with Fuzzer(SEED) as found:
        yield found


@pytest.mark.parametrize("kind", [*KINDS, ASSETS])
def test_spoiled_input(fuzzer: Fuzzer, kind: str) -> None:
    cases = [fuzzer.case(kind, number) for number in range(CASES_A_KIND)]
    print(table(cases))
    assert not [str(case) for case in cases if not case.is_allowed]
    refused = [case for case in cases if case.outcome.kind == REFUSED]
    vague = [str(case) for case in refused if not case.outcome.is_precise]
    assert len(vague) <= 0.1 * len(refused), vague


def test_a_case_is_made_again_alike(fuzzer: Fuzzer) -> None:
    one, other = (fuzzer.case("elements of a scene", 3).outcome for _ in range(2))
    assert (one.arguments, one.code, one.errors) == (other.arguments, other.code, other.errors)


def outcome(code: int, errors: str, hung: bool = False) -> Outcome:
    return Outcome(("check",), code, hung, 1.0, 1.0, 1.0, "", errors)


@pytest.mark.parametrize(
    ("code", "errors", "kind"),
    [(0, "", WORKS), (-11, "", SIGNAL), (1, "Traceback (most recent call last):\n  ...\nValueError: x\n", TRACEBACK),
     (1, "fd_mitsuba: error: a.xml:3: <shape>: is bad\n", REFUSED), (1, "", OTHER), (1, "bad\n", OTHER), (3, "", OTHER),
     (2, "fd_mitsuba: error: the following arguments are required: scene; see fd_mitsuba --help\n", USAGE),
     (1, "[parser.cpp:3] noise\nfd_mitsuba: error: a.xml:3: <shape>: is bad\n", OTHER)],
)  # fmt: skip
def test_how_outcomes_are_told_apart(code: int, errors: str, kind: str) -> None:
    assert outcome(code, errors).kind == kind
    assert outcome(-9, errors, hung=True).kind == HANG


def test_limits_hold(tmp_path: Path) -> None:
    """A run that takes too long is ended, one that wants too much memory does not get it, and the next is well."""
    scene = write_seeds(tmp_path, small_exr())
    with Forked() as forked:
        assert forked.run("check", scene, seconds=0.02).kind == HANG
        forked.megabytes = 500
        assert forked.run("check", scene).kind != WORKS
        forked.megabytes = 6000
        assert forked.run("check", scene).kind == WORKS
