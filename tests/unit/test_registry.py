"""Registries: what is refused, how entries of other packages are found; and every built-in entry, each at work."""

from __future__ import annotations

import importlib
import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from normal_data import chunk, denoiser, how
from pydantic import Field

from fd_mitsuba.config import AppearanceConfig, GeometryConfig, GuidanceConfig, RunConfig, Section
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.config.registry import Registry, load_plugins
from fd_mitsuba.errors import UserError
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.export.formats import EXPORTERS
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.guidance.critic import Critic
from fd_mitsuba.guidance.sources import load_guidance
from fd_mitsuba.guidance.variants import VARIANTS
from fd_mitsuba.losses.curvature import STENCIL
from fd_mitsuba.runs.choices import REGISTRIES, checked_choices, described
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.region_shapes import REGION_SHAPES, shape_arrays
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.triangle_mesh import TriangleMesh, topology
from fd_mitsuba.training import appearance_losses, geometry_losses
from fd_mitsuba.training.appearance_losses import APPEARANCE_LOSSES, TextureSamples
from fd_mitsuba.training.field_losses import FieldLosses
from fd_mitsuba.training.geometry_losses import GEOMETRY_LOSSES, FieldLoss, FieldPlace, FieldSamples

WORK: dict[str, dict[str, Callable[[str], None]]] = {}
"""Kind -> name -> what shows that the entry works; an entry without it fails the walk below."""


def shows(kind: str, *names: str) -> Callable[[Callable[[str], None]], Callable[[str], None]]:
    def add(function: Callable[[str], None]) -> Callable[[str], None]:
        WORK.setdefault(kind, {}).update(dict.fromkeys(names, function))
        return function

    return add


@shows("guidances", "diffusion")
def the_built_in_prior_is_loaded(name: str) -> None:
    assert load_guidance(RunConfig()).needs_base


@shows("variants", "sds", "csd", "ism", "reconstruction")
def a_gradient_points_from_the_free_mean_to_the_text_mean(name: str) -> None:
    """Latents at the free mean, a network that sees 0.8 with the text: against the gradient they grow."""
    what = chunk(300, 700)
    gradient, preview = denoiser().latent_gradient(what, how(name, guidance_scale=7.5))
    assert gradient.shape == preview.shape == what.z.shape and gradient.mean() < 0


@shows("variants", "vsd")
def a_critic_that_has_learned_nothing_is_the_model(name: str) -> None:
    critic = Critic(torch.nn.ModuleDict({"a": torch.nn.ModuleDict({"to_q": torch.nn.Linear(2, 2)})}), 4, 1e-4)
    what = chunk(300, 700)
    gradient, preview = denoiser().latent_gradient(what, how(name, guidance_scale=7.5, critic=critic))
    expected, _ = denoiser().latent_gradient(what, how("csd"))
    torch.testing.assert_close(gradient, 6.5 * expected)
    assert preview.shape == what.z.shape


@shows("geometry_losses", "focal", "collision", "volume", "presence", "tether", "curvature")
def a_loss_moves_the_field_where_it_should(name: str) -> None:
    """In the region, far outside, inside the base, where a loose piece should hang on, and on top of a surface."""
    place = FieldPlace(
        positions=torch.zeros(3, 3),
        sdf_base=torch.tensor([-0.5, -0.5, 0.2]),
        region_sdf=torch.tensor([0.1, -0.5, 0.1]),
        room=torch.tensor([[True, False, False]]),
        spacing=0.1,
        subtracts=False,
        run_seed=0,
    )
    sdf = torch.tensor([-0.02, 0.02, 0.02, -0.1, 0.01], requires_grad=True)
    around = torch.tensor([-0.1 * z for _, _, z in STENCIL])  # a plane but for its middle
    dent = torch.where((torch.tensor(STENCIL) == 0).all(dim=1), sdf[4], around)[None]
    at = FieldSamples(sdf[:3], torch.arange(3), sdf[3:4], place, 0, dent)
    loss = GEOMETRY_LOSSES.make(Choice.of(name), "here")(at)
    loss.backward()
    grows, shrinks = {
        "focal": ([], [1]),
        "collision": ([], [2]),
        "volume": ([], [0, 1, 2]),
        "presence": ([0], []),
        "tether": ([3], []),
        "curvature": ([], [4]),
    }[name]
    sign = torch.zeros(5)
    sign[grows], sign[shrinks] = -1, 1
    assert loss.dim() == 0 and torch.equal(sdf.grad.sign(), sign)


@shows("appearance_losses", "style_gradient", "style_boundary", "bend")
def a_material_loss_is_zero_only_for_the_material_it_wants(name: str) -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))

    def material(values: torch.Tensor, tilt: float = 0.0) -> Any:
        normal = torch.nn.functional.normalize(torch.tensor([[tilt, 0.0, 1.0]]), dim=1).expand(len(values), 3)
        return SimpleNamespace(style=lambda: values, normal=normal)

    known = SimpleNamespace(known=torch.ones(50, 5, dtype=torch.bool), style=lambda: torch.full((50, 5), 0.5))
    surface = SimpleNamespace(
        points=points,
        learned=("normal",),
        run_seed=0,
        say=print,
        chosen=lambda count, size, step: torch.arange(count),
        base=SimpleNamespace(distance=lambda where: torch.zeros(len(where)), lookup=lambda where: known),
    )
    loss = APPEARANCE_LOSSES.make(Choice.of(name), "here", surface)

    def of(field: Callable[[torch.Tensor], Any], texture: Any) -> float:
        return float(loss(TextureSamples(texture, None, field, 0, 0)))

    flat = of(lambda where: material(torch.full((len(where), 5), 0.5)), material(points))
    rough = of(lambda where: material(where.repeat(1, 2)[:, :5]), material(points, 0.5))
    assert flat == 0 and rough > 0


@shows("region_shapes", "ellipsoid", "box", "cylinder")
def a_unit_shape_is_closed_and_encloses_its_volume(name: str) -> None:
    vertices, faces = shape_arrays(Choice.of(name))
    found = topology(vertices, faces)
    assert found.closed and found.components == 1 and not found.degenerate_faces
    exact, tolerance = {"ellipsoid": (4 / 3 * np.pi, 0.01), "box": (8, 1e-12), "cylinder": (2 * np.pi, 0.001)}[name]
    assert TriangleMesh(name, vertices, faces).volume() == pytest.approx(exact, rel=tolerance)


@shows("exporters", "glb", "obj", "ply", "mitsuba", "print", "usdz")
def a_format_leaves_what_it_says(name: str) -> None:
    """`test_every_format_leaves_what_it_says_and_no_other_does` writes them; this is what they are."""
    assert EXPORTERS.entry(name, "here").make.leaves


def built_in(registry: Registry[Any]) -> list[str]:
    entries = [registry.entry(name, "here") for name in registry.names()]
    return [entry.name for entry in entries if entry.make.__module__.startswith("fd_mitsuba.")]


ENTRIES = [(registry, name) for registry in REGISTRIES for name in built_in(registry)]


@pytest.mark.parametrize(("registry", "name"), ENTRIES, ids=lambda item: getattr(item, "kind", item))
def test_every_entry_is_told_has_settings_and_works(registry: Registry[Any], name: str) -> None:
    entry = registry.entry(name, "here")
    assert entry.make.__doc__ and entry.make.__doc__.strip(), "an entry says what it does"
    assert issubclass(entry.settings, Section)
    assert registry.completed(Choice.of(name), "here").kind == name
    with pytest.raises(UserError, match="unknown key 'no_such_key'"):
        registry.settings(Choice.of(name, {"no_such_key": 1}), "here")
    WORK[registry.kind][name](name)


def test_every_format_leaves_what_it_says_and_no_other_does(make_scene: Callable[..., Path], tmp_path: Path) -> None:
    scene = load_edit_scene(make_scene())
    vertices, faces = unit_sphere(2)
    parts = {"part": PartAsset(0.2 * vertices + [0, 0.4, 0], faces)}
    for name in built_in(EXPORTERS):
        if name == "usdz" and importlib.util.find_spec("pxr") is None:
            continue
        export_assets(scene, RunConfig(), parts, tmp_path / name, [name], 64)
        there = [
            other
            for other in built_in(EXPORTERS)
            if (tmp_path / name / EXPORTERS.entry(other, "").make.leaves).exists()
        ]
        assert there == [name]


def test_built_in_losses_have_the_defaults_of_their_flat_settings() -> None:
    for registry, pairs in (
        (GEOMETRY_LOSSES, geometry_losses.built_in_losses(GeometryConfig())),
        (APPEARANCE_LOSSES, appearance_losses.built_in_losses(AppearanceConfig())),
    ):
        assert list(pairs) == built_in(registry)
        for name, (_, choice) in pairs.items():
            assert registry.completed(Choice.of(name), "here") == registry.completed(choice, "here")


def test_weights_of_built_in_losses_are_the_flat_ones() -> None:
    config = RunConfig.load("quick")
    weights = {name: weight for name, (weight, _) in geometry_losses.built_in_losses(config.geometry).items()}
    assert weights == {"focal": 1e5, "collision": 1e5, "volume": 0.5, "presence": 20, "tether": 20, "curvature": 0}
    style = config.appearance.model_copy(update={"style": True})
    weights = {name: weight for name, (weight, _) in appearance_losses.built_in_losses(style).items()}
    assert weights == {"style_gradient": 1000, "style_boundary": 1e5, "bend": 5000}
    assert appearance_losses.built_in_losses(config.appearance)["style_gradient"][0] == 0


# What is refused, in one line.


class Depth(Section):
    depth: float = Field(default=1.0, gt=0)


@pytest.fixture
def own() -> Registry[Any]:
    registry: Registry[Any] = Registry("tests", "test thing")

    @registry.register("thin", Depth)
    def thin(settings: Depth, more: str) -> str:
        return f"{settings.depth} {more}"

    return registry


def test_an_entry_is_called_with_its_settings_and_the_context(own: Registry[Any]) -> None:
    assert own.make(Choice.of("thin", {"depth": 2}), "here", "m") == "2.0 m"
    assert own.completed(Choice.of("thin"), "here").options == {"depth": 1.0}


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (Choice.of("thn"), ("geometry.losses.x: unknown test thing 'thn'", "nearest: thin", "--plugin")),
        (Choice.of("thin", {"dept": 1}), ("geometry.losses.x (thin): unknown key 'dept'", "nearest: depth")),
        (Choice.of("thin", {"depth": -1}), ("geometry.losses.x (thin): depth", "greater than 0", "given: '-1'")),
        (Choice.of("thin", {"depth": "deep"}), ("geometry.losses.x (thin): depth", "given: \"'deep'\"")),
    ],
)
def test_a_wrong_choice_is_one_line_that_names_the_key(
    own: Registry[Any], choice: Choice, words: tuple[str, ...]
) -> None:
    with pytest.raises(UserError) as caught:
        own.make(choice, "geometry.losses.x", "m")
    assert "\n" not in str(caught.value)
    for word in words[:-1]:
        assert word in str(caught.value)


def test_names_that_are_taken_or_no_names_and_settings_without_defaults(own: Registry[Any]) -> None:
    class Needy(Section):
        depth: float

    for name, settings, words in (
        ("thin", Depth, "is taken by"),
        ("Thin", Depth, "lower-case"),
        ("a b", Depth, "lower-case"),
        ("needy", Needy, "lack a default"),
    ):
        with pytest.raises(UserError, match=words):
            own.register(name, settings)(lambda settings: None)


def test_a_notebooks_cell_may_run_twice(own: Registry[Any]) -> None:
    def again(answer: int) -> Callable[..., int]:
        def cell(settings: Section) -> int:
            return answer

        return cell

    for answer in (1, 2):
        own.register("cell")(again(answer))
        assert own.make(Choice.of("cell"), "here") == answer


def install(folder: Path, module: str, name: str = "wide") -> None:
    """What pip leaves of a package with one entry point, whose module has this text."""
    package = folder / "some_package-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: some-package\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text(f"[fd_mitsuba.variants]\n{name} = some_module_of_{folder.name}\n")
    (folder / f"some_module_of_{folder.name}.py").write_text(module)
    importlib.invalidate_caches()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = tmp_path / f"site{abs(hash(tmp_path)) % 10**8}"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr(VARIANTS, "_entries", dict(VARIANTS._entries))
    yield folder
    sys.modules.pop(f"some_module_of_{folder.name}", None)


MODULE = """
import fd_mitsuba as fd

@fd.VARIANTS.register("wide")
class Wide(fd.Variant):
    "Nothing."
    def gradient(self, query):
        return query.chunk.z, query.chunk.z
"""


def test_an_installed_package_is_found_and_loaded_when_it_is_named(site: Path) -> None:
    install(site, MODULE)
    assert "wide" in VARIANTS.names() and f"some_module_of_{site.name}" not in sys.modules
    config = checked_choices(RunConfig(guidance=GuidanceConfig(variant=Choice.of("wide"))))
    assert config.guidance.variant == Choice.of("wide") and "wide" in described()["variants"]
    what = chunk(300)
    assert torch.equal(denoiser().latent_gradient(what, how("wide"))[0], what.z)


@pytest.mark.parametrize(
    ("module", "words"),
    [("import no_such_thing_at_all", "some-package cannot be loaded .ModuleNotFoundError"), ("", "does not register")],
)
def test_a_package_that_is_broken_is_named(site: Path, module: str, words: str) -> None:
    install(site, module)
    with pytest.raises(UserError, match=f"guidance variant 'wide': .*{words}"):
        checked_choices(RunConfig(guidance=GuidanceConfig(variant=Choice.of("wide"))))
    assert VARIANTS.make(Choice.of("sds"), "here"), "the others do not suffer"


def test_a_plugin_is_a_module_or_a_file_and_is_imported_once(site: Path) -> None:
    (site / "mine.py").write_text(MODULE)
    load_plugins([str(site / "mine.py"), str(site / "mine.py")])
    assert "wide" in VARIANTS.names()
    (site / f"some_module_of_{site.name}.py").write_text("VALUE = 1")
    load_plugins([f"some_module_of_{site.name}"])
    assert sys.modules[f"some_module_of_{site.name}"].VALUE == 1


@pytest.mark.parametrize(
    ("plugin", "words"),
    [
        ("no_such_module_at_all", "cannot be imported .ModuleNotFoundError"),
        ("nowhere.py", "nowhere.py: no such file"),
        ("broken.py", "cannot be imported .ZeroDivisionError"),
        ("taken.py", "'sds': is taken by fd_mitsuba.guidance.variants.ScoreDistillation"),
    ],
)
def test_a_plugin_that_cannot_be_imported_is_one_line(site: Path, plugin: str, words: str) -> None:
    (site / "broken.py").write_text("1 / 0")
    (site / "taken.py").write_text(MODULE.replace("wide", "sds"))
    known = plugin in ("broken.py", "taken.py")
    with pytest.raises(UserError, match=words):
        load_plugins([str(site / plugin) if known else plugin])


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("guidance.kind=diffusin", "guidance.kind: unknown guidance 'diffusin'; nearest: diffusion"),
        ("guidance.variant={kind='ism', interval=0}", r"guidance.variant \(ism\): interval"),
        ("guidance.variant={kind='csd', interval=0.1}", r"guidance.variant \(csd\): unknown key 'interval'"),
        ("geometry.losses.thinn.lambda=1", "geometry.losses.thinn: unknown geometry loss"),
        ("geometry.losses.focal.lambda=1", "geometry.losses.focal: is built in"),
        ("appearance.losses.bend.lambda=1", "appearance.losses.bend: is built in"),
        ("appearance.losses.sds.lambda=1", "appearance.losses.sds: is built in"),
    ],
)
def test_wrong_names_in_settings_are_refused_before_a_run(override: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        checked_choices(RunConfig.load(None, [override]))


def test_checked_settings_have_all_options() -> None:
    config = checked_choices(RunConfig.load(None, ["guidance.variant={kind='ism', interval=1}"]))
    record = json.loads(config.model_dump_json())
    assert record["guidance"]["variant"] == {"kind": "ism", "interval": 1.0, "inversion_step": 0.2}
    assert checked_choices(RunConfig.model_validate(record)) == config
    assert checked_choices(RunConfig()) == RunConfig()


class Doubtful(FieldLoss):
    """Counts how often it is made; gives what its settings say."""

    made = 0

    def __init__(self, settings: Section) -> None:
        super().__init__(settings)
        Doubtful.made += 1

    def __call__(self, at: FieldSamples) -> torch.Tensor:
        return at.sdf_part if self.settings.depth > 1 else at.sdf_part.mean()


def field_losses(*overrides: str, subtracts: bool = False) -> FieldLosses:
    off = [f"geometry.lambda_{name}=0" for name in ("focal", "collision")]
    grid = TetGrid(8)
    sdf = torch.zeros(grid.count)
    config = RunConfig.load(None, [*off, *overrides])
    return FieldLosses(config, grid, sdf, sdf[None], torch.arange(grid.count), subtracts)


def test_a_loss_without_weight_is_not_even_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GEOMETRY_LOSSES, "_entries", dict(GEOMETRY_LOSSES._entries))
    GEOMETRY_LOSSES.register("doubtful", Depth)(Doubtful)
    idle = field_losses("geometry.losses.doubtful.lambda=0")
    assert idle.ask(0) is None and idle.weights == {} and Doubtful.made == 0
    busy = field_losses("geometry.losses.doubtful.lambda=2", "geometry.lambda_volume=3")
    asked = busy.ask(0)
    assert asked is not None and busy.weights == {"volume": 3, "doubtful": 2} and Doubtful.made == 1
    assert list(busy(torch.ones(len(asked.drawn)), asked, 0)) == ["volume", "doubtful"]
    monkeypatch.setattr(Doubtful, "in_cuts", False)
    cut = ("geometry.losses.doubtful.lambda=2", "geometry.lambda_volume=3")
    assert field_losses(*cut, subtracts=True).ask(0) is None


def test_a_loss_that_is_no_number_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GEOMETRY_LOSSES, "_entries", dict(GEOMETRY_LOSSES._entries))
    GEOMETRY_LOSSES.register("doubtful", Depth)(Doubtful)
    wrong = field_losses("geometry.losses.doubtful={lambda=1, depth=2}")
    asked = wrong.ask(0)
    assert asked is not None
    with pytest.raises(UserError, match=r"geometry.losses.doubtful: gives a tensor of shape \(\d+,\), not a scalar"):
        wrong(torch.ones(len(asked.drawn)), asked, 0)


def test_what_a_loss_may_use_is_that_of_its_samples() -> None:
    grid = TetGrid(8)
    index = torch.tensor([5, 700])
    values = torch.arange(grid.count, dtype=torch.float32)
    place = FieldPlace(grid.vertices, values, 2 * values, values[None] > 6, grid.spacing, False, 3)
    at = FieldSamples(torch.zeros(2), index, torch.zeros(0), place, 4)
    assert at.sdf_base.tolist() == [5, 700] and at.region_sdf.tolist() == [10, 1400]
    assert at.room.tolist() == [[False, True]] and torch.equal(at.positions, grid.vertices[index])
    other = FieldSamples(torch.zeros(2), index, torch.zeros(0), place, 5)
    assert at.seed != other.seed and at.spacing == grid.spacing


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda vertices, faces: (vertices, faces[1:]), "no closed mesh with faces outward"),
        (lambda vertices, faces: (vertices, faces[:, ::-1]), "no closed mesh with faces outward"),
        (lambda vertices, faces: (vertices, faces + 1), "faces without vertices"),
        (lambda vertices, faces: (vertices * np.nan, faces), "faces without vertices"),
        (lambda vertices, faces: (vertices, faces[:0]), "no faces"),
        (lambda vertices, faces: vertices, "no vertices and faces"),
        (lambda vertices, faces: None, "no vertices and faces"),
    ],
)
def test_a_shape_that_is_no_closed_mesh_is_refused(
    made: Callable[..., Any], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(REGION_SHAPES, "_entries", dict(REGION_SHAPES._entries))
    REGION_SHAPES.register("mine")(lambda settings: made(*map(np.array, unit_sphere(1))))
    with pytest.raises(UserError, match=f"shape 'mine': gives .*{words}"):
        shape_arrays(Choice.of("mine"))


def test_settings_are_read_without_torch() -> None:
    code = (
        "import sys; from fd_mitsuba.config import RunConfig;"
        "RunConfig.load('quick', ['guidance.variant=ism', 'guidance.kind=mine', 'geometry.losses.thin.lambda=1']);"
        "print(sorted({'torch', 'mitsuba', 'drjit'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (result.stdout.strip(), result.stderr) == ("[]", "")
