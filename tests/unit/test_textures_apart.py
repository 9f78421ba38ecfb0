"""Parts whose materials are learned by fields of their own, and how the guidance is asked about each."""

from __future__ import annotations

import numpy as np
import torch

from fd_mitsuba.config.sections import TextureConfig
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.fields.textures_apart import TexturesApart
from fd_mitsuba.guidance.interface import AppearanceViews
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.training.region_masks import one_by_one

SMALL = TextureConfig(levels=4, finest_resolution=32, log2_table=12)


def ball(x: float) -> FocalRegion:
    to_canonical = np.diag([0.2, 0.2, 0.2, 1.0])
    to_canonical[0, 3] = x
    return FocalRegion("ball", to_canonical)


def test_each_point_gets_what_its_own_parts_field_says() -> None:
    fields = [TextureField(SMALL, seed) for seed in (1, 2)]
    for field in fields:
        torch.nn.init.normal_(field.grid.table, std=1.0)
    both = TexturesApart(fields, [(ball(-0.5),), (ball(0.5), ball(0.9))])
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    # Halfway between the balls at -.5 and .5; none of the points is nearer to that at .9 than to .5 on this side.
    second = points[:, 0] > 0
    assert torch.equal(both.owner(points), second.long())
    said, alone = both(points), [field(points) for field in fields]
    for name in ("base_color", "roughness", "metallic", "normal"):
        wanted = torch.where(second[:, None], getattr(alone[1], name), getattr(alone[0], name))
        assert torch.equal(getattr(said, name), wanted)
    one = both(points[second])
    assert len(one.base_color) == int(second.sum()) and both(points[:0]).normal.shape == (0, 3)


def test_a_wish_for_one_part_moves_no_other() -> None:
    both = TexturesApart([TextureField(SMALL, 3), TextureField(SMALL, 3)], [(ball(-0.5),), (ball(0.5),)])
    points = torch.tensor([[-0.5, 0.1, 0.0], [0.5, 0.1, 0.0]])
    before = both(points).base_color.detach()
    assert torch.equal(before[0], before[1])
    optimiser = torch.optim.Adam(both.parameters(), lr=0.05)
    for _ in range(30):
        optimiser.zero_grad()
        both(points).base_color[1, 0].backward()
        optimiser.step()
    after = both(points).base_color.detach()
    assert torch.equal(after[0], before[0]) and after[1, 0] < before[1, 0] - 0.2


def test_the_others_are_shown_as_they_are_and_not_as_new() -> None:
    """Three pixels in a row of a 3 x 3 picture: the crown, the cape, and the base."""

    def picture(*row: float) -> torch.Tensor:
        return torch.tensor(row).expand(1, 3, 3).clone()[None]

    views = AppearanceViews(
        pictures=picture(0.7, 0.3, 0.1).expand(1, 3, 3, 3).clone().requires_grad_(),
        condition=picture(0.5, 0.5, 0.1).expand(1, 3, 3, 3),
        mask=picture(1.0, 1.0, 1.0),
        part_mask=picture(1.0, 0.8, 0.0),
        shine=picture(0.4, 0.2, 0.0),
        azimuth_deg=[0.0],
        elevation_deg=[0.0],
        regions={"crown": picture(1.0, 1.0, 0.0), "cape": picture(0.0, 0.0, 1.0)},
    )
    shown = {"crown": picture(1.0, 0.0, 0.0), "cape": picture(0.0, 1.0, 0.0)}
    crown, cape = one_by_one(views, shown)
    assert crown.condition[0, 0, 0].tolist() == torch.tensor([0.5, 0.3, 0.1]).tolist()
    assert cape.condition[0, 0, 0].tolist() == torch.tensor([0.7, 0.5, 0.1]).tolist()
    assert crown.part_mask[0, 0, 0].tolist() == [1, 0, 0] and crown.shine[0, 0, 0, 1] == 0
    assert torch.allclose(cape.part_mask[0, 0, 0], torch.tensor([0, 0.8, 0]))
    assert crown.regions["crown"].min() == 1 and crown.regions["cape"].max() == 0
    assert crown.pictures is views.pictures and not crown.condition.requires_grad
