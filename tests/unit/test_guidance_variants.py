"""Every variant against closed forms: networks that are perfect for normally distributed data (`normal_data`)."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from normal_data import FREE, SIGMA, TEXT, along_the_path, chunk, denoiser, how, level, noise_seen
from torch import Tensor

from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.chunk import Area, Chunk
from fd_mitsuba.guidance.denoiser import Denoiser
from fd_mitsuba.guidance.device import require_device
from fd_mitsuba.guidance.prompts import TextEmbeddings
from fd_mitsuba.guidance.query import passes_of

BUILT_IN = ("sds", "csd", "ism", "reconstruction")


def gradient(variant: str, what: Chunk, network: Denoiser | None = None, **changes: object) -> Tensor:
    return (network or denoiser()).latent_gradient(what, how(variant, **changes))[0]


@pytest.mark.parametrize("scale", [1.0, 7.5])
def test_sds_is_what_the_network_sees_less_what_was_drawn(scale: float) -> None:
    what, alpha = chunk(100, 700), level(100, 700)
    z_t = alpha.sqrt() * what.z + (1 - alpha).sqrt() * what.noise
    mean = FREE + scale * (TEXT - FREE)
    expected = noise_seen(z_t, alpha, mean) - what.noise
    torch.testing.assert_close(gradient("sds", what, guidance_scale=scale), expected)


@pytest.mark.parametrize("weighting", ["sds", "uniform", "fantasia3d", "inverse"])
def test_csd_has_neither_noise_nor_place_in_it(weighting: str) -> None:
    """Of equal spreads it is w c sqrt(alpha) (m_free - m_text), everywhere the same, whatever the scale."""
    alpha = level(100, 700)
    c = (1 - alpha).sqrt() / (alpha * SIGMA**2 + 1 - alpha)
    w = {"sds": 1 - alpha, "uniform": 1, "fantasia3d": alpha.sqrt() * (1 - alpha), "inverse": 1 / (1 - alpha)}
    expected = (w[weighting] * c * alpha.sqrt() * (FREE - TEXT)).expand(2, 4, 4, 4)
    got = gradient("csd", chunk(100, 700), weighting=weighting, guidance_scale=50.0)
    torch.testing.assert_close(got, expected)


def test_one_step_of_reconstruction_goes_to_the_expected_latents() -> None:
    """E[z | z_t] = m + sqrt(alpha) sigma^2 / v (z_t - sqrt(alpha) m), as for any two normal variables."""
    what, alpha = chunk(100, 700), level(100, 700)
    z_t = alpha.sqrt() * what.z + (1 - alpha).sqrt() * what.noise
    share = alpha.sqrt() * SIGMA**2 / (alpha * SIGMA**2 + 1 - alpha)
    expected = what.z - (TEXT + share * (z_t - alpha.sqrt() * TEXT))
    torch.testing.assert_close(gradient("reconstruction", what, own={"steps": 1}), expected)


def test_many_steps_of_reconstruction_follow_the_path() -> None:
    what, alpha = chunk(300, 900), level(300, 900)
    z_t = alpha.sqrt() * what.z + (1 - alpha).sqrt() * what.noise
    z_0 = along_the_path(z_t, TEXT, alpha, torch.ones_like(alpha))
    errors = [
        (gradient("reconstruction", what, own={"steps": steps}) - (what.z - z_0)).abs().max() for steps in (1, 4, 50)
    ]
    assert errors[0] > 1.5 * errors[1] > 6 * errors[2] and errors[2] < 0.1 * (what.z - z_0).abs().max()


@pytest.mark.parametrize("scale", [1.0, 7.5])
def test_ism_follows_the_path_and_compares_two_levels_of_it(scale: float) -> None:
    what = chunk(300, 900)
    first, start, end = level(0, 0), level(250, 850), level(300, 900)
    z_0 = first.sqrt() * what.z + (1 - first).sqrt() * what.noise
    z_s = along_the_path(z_0, FREE, first, start)
    e_s = noise_seen(z_s, start, FREE)
    z_t = end.sqrt() * (z_s - (1 - start).sqrt() * e_s) / start.sqrt() + (1 - end).sqrt() * e_s
    mean = FREE + scale * (TEXT - FREE)
    expected = noise_seen(z_t, end, mean) - e_s
    errors = [
        (gradient("ism", what, guidance_scale=scale, own={"inversion_step": stride}) - expected).abs().max()
        for stride in (0.3, 0.02)
    ]
    assert errors[1] < 0.3 * errors[0] and errors[1] < 0.02 * expected.abs().max()


def test_ism_is_quiet_where_sds_is_noisy() -> None:
    """A prompt that asks for nothing new: ISM leaves little, SDS the difference of two noises."""
    what = chunk(300, 900)
    what = replace(what, texts=what.texts | {"text": what.texts["plain"]})
    quiet, noisy = (gradient(variant, what).abs().mean() for variant in ("ism", "sds"))
    assert quiet < 0.15 * noisy


def test_ism_near_the_clean_end_needs_no_inversion() -> None:
    network, what = denoiser(), chunk(20)
    assert gradient("ism", what, network).isfinite().all()
    assert len(network.components.unet.seen) == 2, "one look at z_s = z_0, one at z_t"


@pytest.mark.parametrize("channels", [4, 8])
@pytest.mark.parametrize("variant", BUILT_IN)
def test_an_area_has_the_gradient_of_its_own_texts(variant: str, channels: int) -> None:
    """This network sees each latent cell alone: the left half is as if its texts were those of the whole picture."""
    what = chunk(100, 700, base=0.4 if channels == 8 else None)
    own = {"text": torch.full_like(what.texts["text"], -1.5), "image": torch.full_like(what.texts["image"], 0.1)}
    left = torch.zeros(2, 1, 4, 4, dtype=torch.float64)
    left[..., :2] = 1
    settings = {"guidance_scale": 3.0, "image_guidance_scale": 1.5}
    got = gradient(variant, replace(what, areas=(Area(left, own),)), denoiser("epsilon", channels), **settings)
    scene = gradient(variant, what, denoiser("epsilon", channels), **settings)
    part = gradient(variant, replace(what, texts=what.texts | own), denoiser("epsilon", channels), **settings)
    torch.testing.assert_close(got[..., :2], part[..., :2])
    torch.testing.assert_close(got[..., 2:], scene[..., 2:])
    assert (part - scene).abs().min() > 1e-3


@pytest.mark.parametrize("variant", BUILT_IN)
def test_neighbours_do_not_matter(variant: str) -> None:
    together = gradient(variant, chunk(60, 300, 950))
    whole = chunk(60, 300, 950)
    for row in range(3):
        rows = slice(row, row + 1)
        alone = replace(
            whole,
            z=whole.z[rows],
            noise=whole.noise[rows],
            timesteps=whole.timesteps[rows],
            texts={name: text[rows] for name, text in whole.texts.items()},
        )
        torch.testing.assert_close(gradient(variant, alone)[0], together[row], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("channels", [4, 8])
@pytest.mark.parametrize("variant", BUILT_IN)
def test_what_the_network_predicts_does_not_matter(variant: str, channels: int) -> None:
    what = chunk(100, 700, base=0.4 if channels == 8 else None)
    first, *others = (
        gradient(variant, what, denoiser(kind, channels), guidance_scale=3.0)
        for kind in ("epsilon", "v_prediction", "sample")
    )
    assert first.abs().mean() > 0.1
    for other in others:
        torch.testing.assert_close(other, first, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("variant", BUILT_IN)
def test_a_network_that_sees_the_base_means_it_in_both_passes(variant: str) -> None:
    """With the base's latents added to both means, z moved by the same gives the same gradient."""
    plain, seen = chunk(200, 600), chunk(200, 600, base=0.4)
    seen = replace(seen, z=seen.z + 0.4)
    own = {"steps": 1} if variant == "reconstruction" else None
    got = gradient(variant, seen, denoiser(channels=8), guidance_scale=3.0, own=own)
    expected = gradient(variant, plain, guidance_scale=3.0, own=own)
    # ISM leaves clean latents for a level with next to no noise: there the shift is 0.4 sqrt(alpha), not 0.4.
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("variant", BUILT_IN)
def test_a_mask_keeps_noise_and_gradient_inside(variant: str) -> None:
    mask = torch.zeros(2, 1, 4, 4, dtype=torch.float64)
    mask[..., :2] = 1
    network, what = denoiser(), chunk(300, 900, mask=mask)
    got = gradient(variant, what, network)
    assert (got[..., 2:] == 0).all() and (got[..., :2] != 0).all()
    for z_t in network.components.unet.seen:  # what is outside is z without noise, at some level
        ratio = z_t[..., 2:] / what.z.repeat(len(z_t) // 2, 1, 1, 1)[..., 2:]
        torch.testing.assert_close(ratio, ratio[:, :1, :1, :1].expand_as(ratio))


@pytest.mark.parametrize(("variant", "passes"), [("sds", 1), ("csd", 2), ("reconstruction", 4), ("ism", 6)])
def test_passes_of_the_network(variant: str, passes: int) -> None:
    """At scale 1 guidance is one pass; ISM at t = 700 inverts in four strides, looks from z_s, then from z_t."""
    network = denoiser()
    gradient(variant, chunk(700), network)
    assert sum(len(z_t) for z_t in network.components.unet.seen) == passes
    assert set(passes_of(how(variant), False)) == (
        {"text"} if variant in ("sds", "reconstruction") else {"text", "plain"}
    )


def test_seed_decides() -> None:
    for variant in BUILT_IN:
        first, again, other = (gradient(variant, chunk(300, 700, seed=seed)) for seed in (1, 1, 2))
        assert first.equal(again)
        assert first.allclose(other) == (variant == "csd")  # of normal data it sees no noise


def test_scheduled_timesteps_go_once_through_the_range() -> None:
    def due(annealing: str, progress: float) -> int:
        (t,) = sds.scheduled_timesteps((0.2, 0.8), 1001, 3, annealing, progress).unique().tolist()
        return t

    assert [due("linear", p) for p in (0, 0.25, 0.5, 1)] == [800, 650, 500, 200]
    assert [due("sqrt", p) for p in (0, 0.25, 0.5, 1)] == [800, 500, round(800 - 600 * math.sqrt(0.5)), 200]
    assert sds.scheduled_timesteps((0.0, 1.0), 1000, 1, "linear", 1.0).item() == 1
    assert sds.scheduled_timesteps((0.0, 1.0), 1000, 1, "linear", 0.0).item() == 999


def test_devices_that_are_not_there() -> None:
    from fd_mitsuba.errors import UserError

    assert require_device("cpu").type == "cpu"
    for name, available in (("cuda:99", False), ("mps", torch.backends.mps.is_available())):
        if not available:
            with pytest.raises(UserError, match=rf"guidance.device = '{name}': torch .* set guidance.device to cpu"):
                require_device(name)


def test_embeddings_go_where_the_network_is() -> None:
    """The text encoder stays on the CPU beside another device; `meta` stands for one."""

    class Tokenizer:
        model_max_length = 4

        def __call__(self, text: str, **more: object) -> SimpleNamespace:
            ids = [[1, 2, 3, 0]] if more else [1, 2, 3]
            return SimpleNamespace(input_ids=torch.tensor(ids), attention_mask=torch.ones(1, 4))

    class Encoder(torch.nn.Embedding):
        config = SimpleNamespace(max_position_embeddings=4)

        def forward(self, ids: Tensor, attention_mask: Tensor | None) -> tuple[Tensor]:
            assert ids.device.type == "cpu"
            return (super().forward(ids),)

    embeddings = TextEmbeddings(Tokenizer(), Encoder(5, 2), "meta")(["a horse", "a cat"])
    assert embeddings.device.type == "meta" and embeddings.shape == (2, 4, 2)
