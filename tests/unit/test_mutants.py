"""The small faults of the mutation tests: what they are, that each is another program, that reasons are for some."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "mutation"))
from mutants import MARK, mutants  # noqa: E402
from mutate import _SOURCE, TESTS, _fault, _reasons  # noqa: E402

EXAMPLE = '''"""Says nothing."""
from __future__ import annotations
Number = Float[Tensor, "N"]
def area(width: float, height: float = 2.0) -> float:
    """Of a box."""
    if width < 0 and not height:
        width = max(width, key=abs)
    print("x")
    return width * height
'''


def test_the_faults_of_an_example() -> None:
    found = [(mutant.line, mutant.before, mutant.after) for mutant in mutants(EXAMPLE)]
    assert found == [
        (4, "2.0", "4.0"),
        (6, "width < 0 and (not height)", "not (width < 0 and (not height))"),
        (6, "width < 0 and (not height)", "width < 0 or not height"),
        (6, "width < 0", "width <= 0"),
        (6, "0", "1"),
        (6, "not height", "height"),
        (7, "width = max(width, key=abs)", ""),
        (7, "key=abs", "its default"),
        (8, "print('x')", ""),
        (8, "'x'", "'XXx'"),
        (9, "width * height", "width / height"),
    ]


@pytest.mark.parametrize("name", TESTS)
def test_each_is_another_program_and_reasons_are_for_faults_that_are_there(name: str) -> None:
    found = mutants((_SOURCE / name).read_text())
    sources = {mutant.source for mutant in found}
    assert len(sources) == len(found) > 0
    for mutant in found[::7]:
        names: dict[str, object] = {}
        exec(compile(mutant.source.splitlines()[-1], name, "exec"), names)
        assert names[MARK] is True and compile(mutant.source, name, "exec")
    assert set(_reasons().get(name, {})) <= {_fault(str(mutant)) for mutant in found}


def test_the_tests_of_every_module_are_there() -> None:
    root = Path(__file__).parents[1]
    assert all((root / test).is_file() for groups in TESTS.values() for group in groups for test in group)
    assert set(_reasons()) <= set(TESTS)
