"""What is read whole: regular files up to a size."""

from __future__ import annotations

from pathlib import Path

import pytest

from fd_mitsuba.io.regular_file import NotReadable, read_regular


def test_a_limit_beyond_all_memory_takes_none(tmp_path: Path) -> None:
    """`file.read(n)` sets n bytes aside, which the address space of a service may not have."""
    path = tmp_path / "small.ply"
    path.write_bytes(b"ply")
    assert read_regular(path, 1 << 48) == b"ply"


def test_files_longer_than_a_piece_are_whole_and_limits_exact(tmp_path: Path) -> None:
    path = tmp_path / "large.bin"
    content = bytes(range(256)) * 70_000
    path.write_bytes(content)
    assert read_regular(path, len(content)) == content
    with pytest.raises(NotReadable, match="has 17.1 MB, more than 17.1 MB"):
        read_regular(path, len(content) - 1)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="a system without /proc")
def test_a_file_that_tells_no_size_is_read_up_to_the_limit() -> None:
    path = Path("/proc/self/status")
    assert read_regular(path, 1 << 16).startswith(b"Name:")
    with pytest.raises(NotReadable, match="is larger than"):
        read_regular(path, 10)
