"""Vox-E's refinement: cuts against brute force and on a map whose right cut is known, attention against its formula."""

from __future__ import annotations

from itertools import product

import diffusers
import numpy as np
import pytest
import torch
from tiny_pipelines import UNET_1_5, tiny_tokenizer

from fd_mitsuba.baselines.voxels.attention import recorded_attention, split_words, token_places, word_maps
from fd_mitsuba.baselines.voxels.graph_cut import cut_labels, lattice_edges
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.baselines.voxels.refinement import (
    CutSettings,
    as_large,
    attention_grids,
    edit_voxels,
    merged,
    total_variation,
)
from fd_mitsuba.baselines.voxels.rendering import render_values
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.views import CameraBatch

VIEWS = CameraBatch.around(np.arange(6) * 60.0, np.array([40.0, -20.0] * 3), 3.0, 45.0)


def test_cuts_are_the_cheapest_of_all() -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        count = 7
        edges = np.array([(a, b) for a in range(count) for b in range(a + 1, count) if random.random() < 0.5])
        costs = random.integers(1, 9, len(edges)).astype(float)
        edit, rest = np.array([0]), np.array([count - 1])

        def price(side: np.ndarray, edges: np.ndarray = edges, costs: np.ndarray = costs) -> float:
            return float(costs[side[edges[:, 0]] != side[edges[:, 1]]].sum())

        sides = [np.array([True, *middle, False]) for middle in product([False, True], repeat=count - 2)]
        found = cut_labels(edges, costs, count, edit, rest)
        assert found[0] and not found[-1]
        assert price(found) == min(map(price, sides))
    assert not cut_labels(np.array([[0, 1]]), np.ones(1), 2, np.array([1]), np.array([1])).any(), "no seed of the edit"


def test_edges_of_a_lattice_join_neighbours_alone() -> None:
    occupied = np.zeros((2, 2, 3), dtype=bool)
    occupied[0, 0] = occupied[1, 0, 0] = True
    pairs = {tuple(sorted(pair)) for pair in lattice_edges(occupied).tolist()}
    assert pairs == {(0, 1), (1, 2), (0, 3)}


def two_balls() -> tuple[VoxelGrid, VoxelGrid, torch.Tensor]:
    """Base and edited grid, and which voxels are the new ball's: it touches the base's, and its features differ."""
    base, edited = VoxelGrid(33), VoxelGrid(33)
    places = base.vertices()
    old = (0.45 - (places - torch.tensor([0, -0.2, 0])).norm(dim=1)).view(33, 33, 33)
    new = (0.3 - (places - torch.tensor([0, 0.5, 0])).norm(dim=1)).view(33, 33, 33)
    with torch.no_grad():
        for grid, level in ((base, old), (edited, torch.maximum(old, new))):
            grid.density.copy_((level * 60).clamp(-8, 4) + grid.raw_of_alpha(0.5))
            grid.features[1] = 1.0
        edited.features[:, new > old] = torch.tensor([1.0, 0.0, 0.0])[:, None]
    return base, edited, (new > 0) & (new > old)


def test_the_cut_is_right_on_a_map_of_which_it_is_known() -> None:
    base, edited, wanted = two_balls()
    occupied = edited.density > edited.raw_of_alpha(0.5)
    # Attention that is sure of the ends, and takes the upper part of the old ball for new.
    height = edited.vertices()[:, 1].view(33, 33, 33)
    attention = torch.stack([height, 0.15 - height])
    found = edit_voxels(edited, attention, CutSettings())
    plain = (attention[0] > attention[1]) & occupied
    assert (plain & ~wanted).sum() > 50, "the map alone would cut elsewhere"
    assert (found != wanted).sum() <= 0.02 * wanted.sum()
    made = merged(edited, base, found)
    below = height < 0
    assert torch.equal(made.density[below], base.density[below])
    solid = made.density > made.raw_of_alpha(0.5)
    assert (solid != occupied).sum() <= 0.02 * occupied.sum()
    nothing = torch.zeros_like(found)
    assert torch.equal(merged(edited, base, nothing).density, base.density)


def test_attention_grids_render_as_the_maps() -> None:
    _, edited, _ = two_balls()
    height = edited.vertices()[:, 1].view(1, 33, 33, 33)
    truth = torch.cat([(height > 0.2).float(), (height <= 0.2).float()])
    covered = render_values(edited, torch.ones(1, 33, 33, 33), VIEWS, 24, 48)
    maps = render_values(edited, truth, VIEWS, 24, 48) / covered.clamp(min=1e-6)
    values = attention_grids(edited, maps, VIEWS, 48, 50, 0.01)
    made = render_values(edited, values, VIEWS, 24, 48)
    seen = (covered > 0.9).expand_as(made)
    assert (made - maps)[seen].abs().mean() < 0.06
    flat = attention_grids(edited, maps, VIEWS, 48, 50, 1e3)
    assert total_variation(flat) < 0.4 * total_variation(values)


def test_total_variation_and_sizes_by_hand() -> None:
    values = torch.zeros(1, 2, 2, 2)
    values[0, 1] = 3
    assert total_variation(values).item() == pytest.approx(3.0)
    maps = torch.tensor([0.0, 4.0]).view(1, 1, 1, 2).expand(1, 1, 2, 2)
    assert as_large(maps, 4)[0, 0, 0].tolist() == [0, 1, 3, 4]


def test_recorded_attention_is_the_softmax_of_queries_and_keys_and_changes_nothing() -> None:
    torch.manual_seed(0)
    unet = diffusers.UNet2DConditionModel(**UNET_1_5).eval()
    z, text = torch.randn(1, 4, 16, 16), torch.randn(1, 5, 48)
    seen: dict[str, torch.Tensor] = {}
    name = "down_blocks.1.attentions.0.transformer_blocks.0.attn2"
    module = unet.get_submodule(name)
    handle = module.register_forward_pre_hook(lambda _, args: seen.update(states=args[0]))
    with torch.no_grad():
        before = unet(z, 10, text)[0]
        with recorded_attention(unet) as maps:
            during = unet(z, 10, text)[0]
        after = unet(z, 10, text)[0]
    handle.remove()
    assert torch.equal(before, during) and torch.equal(before, after)
    sizes = sorted({len(found[0]) for found in maps})
    assert sizes == [4, 16, 64, 256] and all(torch.allclose(found.sum(dim=2), torch.ones(1)) for found in maps)
    heads = module.heads
    query, key = module.to_q(seen["states"])[0], module.to_k(text)[0]
    width = query.shape[1] // heads
    products = torch.einsum("phc,thc->hpt", query.view(-1, heads, width), key.view(-1, heads, width))
    wanted = (products / width**0.5).softmax(dim=2).mean(dim=0).detach()
    assert any(found[0].shape == wanted.shape and torch.allclose(found[0], wanted, atol=1e-5) for found in maps)
    made = word_maps(maps, [[1, 2], [3]], 8)
    layers = torch.stack([found[0] for found in maps if found.shape[1] == 64]).mean(dim=0)
    assert torch.allclose(made[0].flatten(), torch.maximum(layers[:, 1], layers[:, 2]))
    assert word_maps(maps, [[1]], 32).shape == (1, 32, 32)


def test_words_of_the_edit_and_their_places() -> None:
    assert split_words("a horse with two wings", "a horse") == (["wings"], ["horse"])
    assert split_words("a horse with a crown", "", "crown") == (["crown"], ["horse"])
    for words, hint in ((("a horse", "a horse"), "edit_word"), (("a horse with wings", ""), "edit_word")):
        with pytest.raises(UserError, match=hint):
            split_words(*words)
    with pytest.raises(UserError, match="is not in the prompt"):
        split_words("a horse with wings", "a horse", "hat")
    tokenizer = tiny_tokenizer()
    ids = tokenizer("a horse with wings").input_ids
    assert token_places(tokenizer, "a horse with wings", ["wings"]) == [len(ids) - 2]
    assert token_places(tokenizer, "a horse with wings", ["a", "horse"]) == [1, 2]
    long = token_places(tokenizer, "a horse with zig", ["zig"])
    assert len(long) == 3 and long == list(range(4, 7))
