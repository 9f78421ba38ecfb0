"""Variational score distillation on a random pipeline, against PyTorch's own gradients of merged weights."""

from __future__ import annotations

from pathlib import Path

import diffusers
import pytest
import tiny_guidance
import torch
from tiny_pipelines import build_pipeline
from torch import Tensor
from torch.func import functional_call

from fd_mitsuba.backend.processes import Processes
from fd_mitsuba.errors import RunStopped, UserError
from fd_mitsuba.guidance import critic as module
from fd_mitsuba.guidance import picture_gradient, step_draws
from fd_mitsuba.guidance.critic import Critic
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import GuidanceViews
from fd_mitsuba.training.checkpoint import CheckpointHeader, load_newest, save_checkpoint

RATE, SIDE = 0.01, 8


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stable Diffusion 1.5's layout with the smallest UNet that has attention at two widths."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(4)
        unet = diffusers.UNet2DConditionModel(
            sample_size=SIDE,
            block_out_channels=(32, 64),
            down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
            up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"),
            layers_per_block=1,
            attention_head_dim=2,
            cross_attention_dim=48,
        )
    pipeline = build_pipeline("sd15", with_unet=False)
    pipeline.register_modules(unet=unet)
    place = tmp_path_factory.mktemp("small")
    pipeline.save_pretrained(place)
    return place


def load(folder: Path, **settings: object) -> DiffusionGuidance:
    variant = {"kind": "vsd", "rank": 2, "learning_rate": RATE}
    known = {"variant": variant, "view_prompts": False, "guidance_scale": 7.5, "views_per_call": 8} | settings
    return tiny_guidance.load(folder, **known)


def views_of(count: int = 2, share: slice | None = None) -> GuidanceViews:
    pictures = torch.rand(4, 5, SIDE, SIDE, generator=torch.Generator().manual_seed(1))[:count][share or slice(None)]
    return GuidanceViews(pictures.requires_grad_(), None, [0.0] * len(pictures), [20.0] * len(pictures), share=share)


def gradient_of(guidance: DiffusionGuidance, step: int, views: GuidanceViews | None = None) -> Tensor:
    views = views or views_of()
    return torch.autograd.grad(guidance.guide(views, step, 10, "coarse", seed=3).loss, views.pictures)[0][:, :4]


class Reference:
    """The same critic with W + up down as the UNet's weights, in functions of PyTorch alone."""

    def __init__(self, folder: Path, start: dict[str, Tensor]) -> None:
        self.pipeline = diffusers.StableDiffusionPipeline.from_pretrained(folder, safety_checker=None)
        self.unet, self.alpha_bars = self.pipeline.unet, self.pipeline.scheduler.alphas_cumprod
        self.matrices = {name[7:]: value.clone().requires_grad_() for name, value in start.items()}
        self.optimiser = torch.optim.AdamW(self.matrices.values(), lr=RATE, weight_decay=0)
        texts = self.pipeline.encode_prompt(["a horse with wings"] * 2, "cpu", 1, True, ["blurry"] * 2)
        self.texts = [text.detach() for text in texts]

    def noise(self, z_t: Tensor, t: Tensor, critic: bool, text: int = 0) -> Tensor:
        weights = dict(self.unet.named_parameters())
        for name in {name.rpartition(".")[0] for name in self.matrices} if critic else ():
            change = self.matrices[f"{name}.up"] @ self.matrices[f"{name}.down"]
            weights[f"{name}.weight"] = weights[f"{name}.weight"] + change
        return functional_call(self.unet, weights, (z_t, t, self.texts[text])).sample

    def noised(self, z: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        return self.pipeline.scheduler.add_noise(z, noise, t)

    @torch.no_grad()
    def gradient(self, z: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        z_t, alpha_bar = self.noised(z, t, noise), self.alpha_bars[t].view(-1, 1, 1, 1)
        text, plain = (self.noise(z_t, t, False, which) for which in (0, 1))
        return (1 - alpha_bar) * (plain + 7.5 * (text - plain) - self.noise(z_t, t, True)) / len(z)

    def learn(self, z: Tensor, t: Tensor, noise: Tensor) -> float:
        loss = (self.noise(self.noised(z, t, noise), t, True) - noise).square().mean()
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        return float(loss.detach())


@pytest.mark.parametrize(("views_per_call", "steps"), [(2, 2), (8, 3)])
def test_steps_by_hand(folder: Path, views_per_call: int, steps: int) -> None:
    """Gradients and lessons; before the first one the critic is the model itself. In chunks of one picture or whole."""
    guidance = load(folder, views_per_call=views_per_call)
    start = {name: value for name, value in guidance.learned_state().items() if name.startswith("matrix.")}
    assert all((value == 0).all() == name.endswith("up") for name, value in start.items())
    reference, z = Reference(folder, start), views_of().pictures.detach()[:, :4]
    for step in range(steps):
        drawn = guidance.draws.of_step(2, step, 10, "coarse", 3)
        lesson = guidance.draws.lesson(views_of(), step, "coarse", 3)
        expected = reference.gradient(z, *drawn)
        views = views_of()
        result = guidance.guide(views, step, 10, "coarse", 3)
        got = torch.autograd.grad(result.loss, views.pictures)[0][:, :4]
        assert (got - expected).abs().max() < 1e-4 * expected.abs().max()
        assert result.logs["guidance_critic_loss"] == pytest.approx(reference.learn(z, *lesson), rel=1e-4)


def test_what_was_learned_goes_through_a_checkpoint(folder: Path, tmp_path: Path) -> None:
    """Two steps, a file, another one in another process: the same bytes as three in one."""
    whole, first, second = (load(folder) for _ in range(3))
    expected = [gradient_of(whole, step) for step in range(3)]
    for step in range(2):
        assert gradient_of(first, step).equal(expected[step])
    field = torch.nn.Linear(1, 1)
    optimiser = torch.optim.AdamW(field.parameters())
    save_checkpoint(tmp_path, CheckpointHeader("geometry", 2, "hash"), field, optimiser, 1, first)
    assert load_newest(tmp_path, "geometry", "hash", field, optimiser, guidance=second)[0] == 2
    assert gradient_of(second, 2).equal(expected[2])
    assert not gradient_of(load(folder), 2).equal(expected[2])
    other = load(folder, variant={"kind": "vsd", "rank": 3})
    with pytest.raises(UserError, match="step_000002.safetensors: the critic's matrices are those of another model"):
        load_newest(tmp_path, "geometry", "hash", field, optimiser, guidance=other)


def test_a_phase_starts_with_nothing_learned(folder: Path) -> None:
    guidance = load(folder)
    first = [gradient_of(guidance, step) for step in range(2)]
    assert [gradient_of(guidance, step).equal(first[step]) for step in range(2)] == [True, True]


def test_the_model_itself_stays_as_it_is(folder: Path) -> None:
    guidance, plain = load(folder), load(folder, variant="csd")
    before = gradient_of(plain, 0)
    for step in range(2):
        gradient_of(guidance, step)
    assert gradient_of(plain, 0).equal(before)
    with torch.no_grad():
        guidance.guide(views_of(), 0, 10, "coarse", 3)
    assert all((value == 0).all() for name, value in guidance.learned_state().items() if name.endswith("up"))
    assert plain.learned_state() == {}


def test_the_same_lesson_again_and_again_is_learned(folder: Path) -> None:
    guidance = load(folder)
    losses = [guidance.guide(views_of(), 1, 10, "coarse", 3).logs["guidance_critic_loss"] for _ in range(3)]
    assert losses == sorted(losses, reverse=True) and losses[-1] < losses[0]


def test_two_processes_learn_together(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The gradients that they add up are those of one process."""
    given: dict[int, list[Tensor]] = {}

    class Recording(Processes):
        def add_up(self, tensors: list[Tensor]) -> None:
            given.setdefault(self.rank if self.count > 1 else 9, []).extend(tensor.clone() for tensor in tensors)

    for rank, count in ((0, 1), (0, 2), (1, 2)):
        for place in (picture_gradient, step_draws, module):
            monkeypatch.setattr(place, "processes", lambda rank=rank, count=count: Recording(rank, count))
        share = Processes(rank, count).share(4)
        gradient_of(load(folder), 0, views_of(4, share if count > 1 else None))
    assert len(given[9]) > 10
    for whole, one, two in zip(given[9], given[0], given[1], strict=True):
        torch.testing.assert_close(one + two, whole, rtol=1e-4, atol=1e-7)


def test_what_cannot_be_learned_is_one_line(folder: Path) -> None:
    with pytest.raises(UserError, match="critic learns is too small for float16; set guidance.dtype to bfloat16"):
        load(folder, dtype="float16")
    with pytest.raises(UserError, match="guidance.variant = vsd: the model's UNet has no attention"):
        Critic(torch.nn.Sequential(torch.nn.Conv2d(4, 4, 3)), 4, 1e-4)
    critic = Critic(torch.nn.ModuleDict({"a": torch.nn.ModuleDict({"to_q": torch.nn.Linear(2, 2)})}), 4, 1e-4)
    for name, matrix in critic._matrices.items():
        matrix.grad = torch.full_like(matrix, float("nan") if name.endswith("up") else 0.0)
    with pytest.raises(RunStopped, match="the critic's gradient is not finite"):
        critic.take_step()
