"""A damaged JSON file is told with the place of its fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from fd_mitsuba.io.json_object import json_fault, read_json_object


@pytest.mark.parametrize(
    ("data", "fault"),
    [
        (b'{"a": 1}\n', ""),
        (b'{"a": 1,\n "b": }\n', "line 2, column 7: Expecting value"),
        (b'{"a": 1,\n "b": "\xe9t\xe9"}\n', "line 2: byte 0xe9 is not UTF-8"),
        (b"[1, 2]\n", "line 1: no object {...}"),
        (b'{"a": ' + b"[" * 40 + b"]" * 40 + b"}", "nested deeper than 32"),
        (b'{"a": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "nested deeper than 32"),
        (b"", "line 1, column 1: Expecting value"),
    ],
    ids=["sound", "syntax", "bytes", "list", "deep", "very deep", "empty"],
)
def test_the_fault_of_a_file_has_a_place(tmp_path: Path, data: bytes, fault: str) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(data)
    assert json_fault(path) == fault
    assert (read_json_object(path) is None) == bool(fault)


def test_what_is_no_file_is_said(tmp_path: Path) -> None:
    assert json_fault(tmp_path) == "no regular file"
    assert "No such file" in json_fault(tmp_path / "none.json")
