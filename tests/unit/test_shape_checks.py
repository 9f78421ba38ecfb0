"""Shapes in annotations are checked while the tests run: a wrong one does not pass."""

from __future__ import annotations

import importlib

import jaxtyping
import pytest
import torch
from shape_checks import PLACES

from fd_mitsuba.extraction.union_surface import UnionSurface
from fd_mitsuba.fields.union import soft_union
from fd_mitsuba.guidance import sds
from fd_mitsuba.losses.presence import loss_presence


def test_the_places_are_there() -> None:
    for name in PLACES:
        importlib.import_module(name)


def test_a_wrong_number_of_points_is_caught() -> None:
    soft_union(torch.zeros(4), torch.zeros(4), 0.1)
    with pytest.raises(jaxtyping.TypeCheckError, match="sdf_part"):
        soft_union(torch.zeros(4), torch.zeros(1), 0.1)  # torch itself would repeat the one


def test_a_transposed_matrix_and_a_wrong_dtype_are_caught() -> None:
    members = torch.ones(2, 3, dtype=torch.bool)
    loss_presence(torch.zeros(3), members, 0.5, 0.1)
    with pytest.raises(jaxtyping.TypeCheckError, match="members"):
        loss_presence(torch.zeros(3), members.t(), 0.5, 0.1)
    with pytest.raises(jaxtyping.TypeCheckError, match="members"):
        loss_presence(torch.zeros(3), members.long(), 0.5, 0.1)


def test_one_level_for_every_latent() -> None:
    latents = torch.zeros(2, 4, 8, 8)
    with pytest.raises(jaxtyping.TypeCheckError, match="alpha_bar"):
        sds.add_noise(latents, latents, torch.ones(1))  # torch itself would repeat the one


def test_a_surface_has_one_weight_a_vertex() -> None:
    faces = torch.tensor([[0, 1, 2]])
    UnionSurface(torch.zeros(3, 3), faces, torch.zeros(3), torch.zeros(1, dtype=torch.bool), torch.zeros(0))
    with pytest.raises(jaxtyping.TypeCheckError):
        UnionSurface(torch.zeros(3, 3), faces, torch.zeros(1), torch.zeros(1, dtype=torch.bool), torch.zeros(0))
