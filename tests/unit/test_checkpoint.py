"""Checkpoints: exact round trips, and every kind of damage ends in the last good state or in one line."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.atomic import is_litter, write_atomically
from fd_mitsuba.training.checkpoint import (
    CheckpointHeader,
    checkpoint_path,
    list_checkpoints,
    load_newest,
    save_checkpoint,
)

HASH = "0123456789abcdef"


def make(seed: int, steps: int = 0, width: int = 5) -> tuple[nn.Module, torch.optim.Optimizer]:
    generator = torch.Generator().manual_seed(seed)
    field = nn.Sequential(nn.Linear(3, width), nn.Linear(width, 1))
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))
    optimiser = torch.optim.AdamW(field.parameters(), lr=0.1)
    for step in range(steps):
        advance(field, optimiser, step)
    return field, optimiser


def advance(field: nn.Module, optimiser: torch.optim.Optimizer, step: int) -> None:
    points = torch.randn(8, 3, generator=torch.Generator().manual_seed(step))
    optimiser.zero_grad()
    field(points).square().mean().backward()
    optimiser.step()


def store(folder: Path, step: int, keep: int = 5, **header: object) -> tuple[nn.Module, torch.optim.Optimizer]:
    field, optimiser = make(1, step)
    save_checkpoint(folder, CheckpointHeader(**{"stage": "geometry", "step": step, "config_hash": HASH} | header),
                    field, optimiser, keep)  # fmt: skip
    return field, optimiser


def load(folder: Path, width: int = 5, stage: str = "geometry", config_hash: str = HASH):
    field, optimiser = make(2, 1, width)
    step, remarks = load_newest(folder, stage, config_hash, field, optimiser)
    return step, remarks, field, optimiser


def refusal(folder: Path, **arguments: object) -> str:
    with pytest.raises(UserError) as caught:
        load(folder, **arguments)
    message = str(caught.value)
    assert "\n" not in message and str(folder) in message and ";" in message
    return message


def test_round_trip_goes_on_exactly(tmp_path: Path) -> None:
    field, optimiser = store(tmp_path, 3)
    step, remarks, other, other_optimiser = load(tmp_path)
    assert (step, remarks) == (3, [])
    for index, state in optimiser.state_dict()["state"].items():
        for name, value in state.items():
            assert torch.equal(value, other_optimiser.state_dict()["state"][index][name])
    for step in (3, 4):
        advance(field, optimiser, step)
        advance(other, other_optimiser, step)
    assert all(torch.equal(a, b) for a, b in zip(field.parameters(), other.parameters(), strict=True))


def test_same_state_gives_the_same_bytes(tmp_path: Path) -> None:
    store(tmp_path / "a", 2)
    store(tmp_path / "b", 2)
    assert checkpoint_path(tmp_path / "a", 2).read_bytes() == checkpoint_path(tmp_path / "b", 2).read_bytes()


def test_no_folder_and_no_checkpoint(tmp_path: Path) -> None:
    assert load(tmp_path / "none")[:2] == (0, [])
    (tmp_path / "step_x.safetensors").write_text("a stray")
    (tmp_path / "notes.txt").write_text("another")
    assert load(tmp_path)[:2] == (0, [])


def test_only_the_newest_are_kept_and_strays_stay(tmp_path: Path) -> None:
    (tmp_path / "step_final.safetensors").write_text("a stray")
    for step in (1, 2, 10, 100, 1000000):
        field, optimiser = make(1, 1)
        save_checkpoint(tmp_path, CheckpointHeader("geometry", step, HASH), field, optimiser, keep=2)
    assert [path.name for path in list_checkpoints(tmp_path)] == ["step_000100.safetensors", "step_1000000.safetensors"]
    assert (tmp_path / "step_final.safetensors").exists()
    assert not [path for path in tmp_path.iterdir() if is_litter(path)]


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _noise(path: Path) -> None:
    path.write_bytes(b"\xff" * 200)


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-30] ^= 0x10
    path.write_bytes(bytes(data))


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("damage", [_cut, _empty, _noise, _flip, _folder])
def test_damaged_newest_is_passed_over(tmp_path: Path, damage) -> None:
    store(tmp_path, 2)
    store(tmp_path, 4)
    damage(checkpoint_path(tmp_path, 4))
    step, remarks, _, _ = load(tmp_path)
    assert step == 2
    assert len(remarks) == 1 and "step_000004" in remarks[0] and "\n" not in remarks[0]


def test_damaged_later_file_never_pushes_out_a_good_one(tmp_path: Path) -> None:
    store(tmp_path, 6)
    _flip(checkpoint_path(tmp_path, 6))
    store(tmp_path, 3, keep=1)
    assert load(tmp_path)[0] == 3
    assert list_checkpoints(tmp_path) == [checkpoint_path(tmp_path, 3)]


def test_all_damaged_starts_anew(tmp_path: Path) -> None:
    store(tmp_path, 2)
    _cut(checkpoint_path(tmp_path, 2))
    step, remarks, field, _ = load(tmp_path)
    assert step == 0 and len(remarks) == 1
    untouched = make(2, 1)[0]
    assert all(torch.equal(a, b) for a, b in zip(field.parameters(), untouched.parameters(), strict=True))


def test_wrong_settings_stage_format_shape(tmp_path: Path) -> None:
    store(tmp_path / "a", 2)
    assert "other settings" in refusal(tmp_path / "a", config_hash="x")
    assert "stage 'geometry', not 'appearance'" in refusal(tmp_path / "a", stage="appearance")
    assert "do not fit this field" in refusal(tmp_path / "a", width=6)
    store(tmp_path / "b", 2, format=99)
    assert "format 99" in refusal(tmp_path / "b")


def rewrite(path: Path, change) -> None:
    """Change the tensors and the header of a checkpoint by hand."""
    from fd_mitsuba.training import checkpoint

    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["fd_mitsuba"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    change(tensors, header)
    header["sha256"] = checkpoint._digest(tensors)
    save_file(tensors, path, metadata={"fd_mitsuba": json.dumps(header)})


def _nan(tensors: dict, header: dict) -> None:
    tensors["optimiser.0.exp_avg"][0] = float("nan")


def _missing(tensors: dict, header: dict) -> None:
    del tensors["field.0.weight"]


def _extra(tensors: dict, header: dict) -> None:
    tensors["field.more"] = torch.zeros(3)


def _stranger(tensors: dict, header: dict) -> None:
    tensors["optimiser.77.exp_avg"] = torch.zeros(3)


def _not_a_number(tensors: dict, header: dict) -> None:
    tensors["optimiser.x.exp_avg"] = torch.zeros(3)


def _moments_of_another_shape(tensors: dict, header: dict) -> None:
    tensors["optimiser.0.exp_avg"] = torch.zeros(2, 2)


def _no_step(tensors: dict, header: dict) -> None:
    del header["step"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_nan, "not finite"),
        (_missing, "do not fit this field"),
        (_extra, "do not fit this field"),
        (_stranger, "optimiser"),
        (_not_a_number, "optimiser"),
        (_moments_of_another_shape, "optimiser"),
        (_no_step, "no step"),
    ],
)
def test_whole_files_that_do_not_fit(tmp_path: Path, change, words: str) -> None:
    store(tmp_path, 2)
    rewrite(checkpoint_path(tmp_path, 2), change)
    assert words in refusal(tmp_path)


def test_refused_checkpoint_leaves_the_field_alone(tmp_path: Path) -> None:
    store(tmp_path, 2)
    rewrite(checkpoint_path(tmp_path, 2), _stranger)
    field, optimiser = make(2, 1)
    before = {name: value.clone() for name, value in field.state_dict().items()}
    with pytest.raises(UserError):
        load_newest(tmp_path, "geometry", HASH, field, optimiser)
    assert all(torch.equal(value, before[name]) for name, value in field.state_dict().items())


def test_other_safetensors_file(tmp_path: Path) -> None:
    save_file({"x": torch.zeros(3)}, checkpoint_path(tmp_path, 2))
    assert "not a checkpoint of fd_mitsuba" in refusal(tmp_path)


@pytest.mark.parametrize("call", ["replace", "fsync"])
def test_failed_write_keeps_the_old_and_no_litter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    store(tmp_path, 2, keep=1)
    before = checkpoint_path(tmp_path, 2).read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full)
        with pytest.raises(UserError, match="No space left on device.*free space"):
            store(tmp_path, 4, keep=1)
    assert [path.name for path in tmp_path.iterdir()] == ["step_000002.safetensors"]
    assert checkpoint_path(tmp_path, 2).read_bytes() == before
    assert load(tmp_path)[0] == 2


def test_killed_write_is_ignored(tmp_path: Path) -> None:
    store(tmp_path, 2)
    (tmp_path / ".step_000004.safetensors.123.tmp").write_bytes(b"half")
    assert load(tmp_path)[0] == 2


def test_path_below_a_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="cannot be written"):
        write_atomically(tmp_path / "file" / "below", b"data")
    with pytest.raises(UserError, match="cannot be written"):
        write_atomically(Path("/proc/fd_mitsuba_test/x"), b"data")


def test_write_replaces_whole_files(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "file"
    write_atomically(path, b"first, and longer")
    write_atomically(path, b"second")
    assert path.read_bytes() == b"second" and [p.name for p in path.parent.iterdir()] == ["file"]
