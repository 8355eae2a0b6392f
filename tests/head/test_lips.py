from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from heads import MOUTH_COLUMNS, OPEN, SMILE, grid_head, mouth_head

from avatar.head.assets import HeadAssets, load_head_assets
from avatar.head.lips import lip_gap, lip_pairs
from avatar.head.model import HeadModel


def test_lips_are_paired_across_the_mouth_and_not_along_a_lip() -> None:
    head = mouth_head()
    pairs = lip_pairs(head)
    upper, lower = head.template[pairs[:, 0]], head.template[pairs[:, 1]]
    assert torch.equal(upper, lower), "the lips touch, so each vertex has its copy on the other lip"
    assert (pairs[:, 0] != pairs[:, 1]).all()
    # In the middle half of the mouth the way round a corner is longer than half of the mouth.
    half = (MOUTH_COLUMNS[1] - MOUTH_COLUMNS[0]) * 0.002 / 4
    assert 9 <= len(pairs) <= 11 and float(upper[:, 0].abs().max()) < half + 0.001


def test_the_gap_is_the_lips_distance_in_metres() -> None:
    head = mouth_head()
    pairs, template = lip_pairs(head), head.template[None]
    opened = template + head.expression_dirs[:, :, OPEN]
    assert lip_gap(template, pairs).item() == 0.0
    assert 0.008 < lip_gap(opened, pairs).item() < 0.0101
    both = lip_gap(torch.cat((template, opened, template + 0.5 * head.expression_dirs[:, :, OPEN])), pairs)
    torch.testing.assert_close(both[2], both[1] / 2)
    assert lip_gap(template + 0.1 * head.expression_dirs[:, :, SMILE], pairs).item() < 1e-6


def without(head: HeadAssets, change: str) -> HeadAssets:
    if change == "no region":
        return replace(head, regions={})
    if change == "an empty region":
        return replace(head, regions={"lips": torch.zeros(0, dtype=torch.int64)})
    if change == "a mouth that is open in the template":
        return replace(head, template=head.template + head.expression_dirs[:, :, OPEN])
    return grid_head()


@pytest.mark.parametrize(
    "change", ["no region", "an empty region", "a mouth that is open in the template", "a mouth that cannot open"]
)
def test_heads_that_do_not_show_their_lips_have_no_pairs(change: str) -> None:
    assert tuple(lip_pairs(without(mouth_head(), change)).shape) == (0, 2)


def test_the_rest_of_the_mesh_does_not_matter() -> None:
    """Vertices in another order, other scale, and faces far away."""
    head = mouth_head()
    order = torch.randperm(head.num_vertices)
    place = order.argsort()
    shuffled = replace(
        head,
        template=10 * head.template[order],
        faces=place[head.faces],
        regions={"lips": place[head.regions["lips"]]},
    )
    expected = {frozenset(pair) for pair in lip_pairs(head).tolist()}
    assert {frozenset(order[pair].tolist()) for pair in lip_pairs(shuffled)} == expected


@pytest.mark.shared
def test_flames_own_topology(shared_dir: Path) -> None:
    """FLAME 2023 Open, its lips taken from a box (the region masks are not with it): the jaw's rotation opens them."""
    with np.load(shared_dir / "assets" / "flame2023open" / "flame2023open_arkit.npz") as file:
        arrays = {name: file[name] for name in ("v_template", "f", "posedirs", "J_regressor", "weights")}
    template = arrays["v_template"]
    x, y, z = template.T
    lips = np.flatnonzero((abs(x) < 0.027) & (y < -0.0365) & (y > -0.0555) & (z > 0.035))
    tensors = {name: torch.from_numpy(np.asarray(array, np.float32)) for name, array in arrays.items() if name != "f"}
    head = replace(
        grid_head(),
        template=tensors["v_template"],
        faces=torch.from_numpy(arrays["f"].astype(np.int64)),
        uv_faces=torch.from_numpy(arrays["f"].astype(np.int64)),
        uvs=torch.zeros(len(template), 2),
        shape_dirs=torch.zeros(len(template), 3, 300),
        expression_dirs=torch.zeros(len(template), 3, 1),
        pose_dirs=tensors["posedirs"],
        joint_regressor=tensors["J_regressor"],
        weights=tensors["weights"],
        eyelid_dirs=torch.zeros(2, len(template), 3),
        regions={"lips": torch.from_numpy(lips)},
    )
    assert_opens_with_the_jaw(head, millimetres_per_degree=1.5)


@pytest.mark.shared
def test_a_head_model_of_another_topology(shared_dir: Path) -> None:
    """Expressions 26 to 30 and 35 open this head's mouth; brows, eyes and nose (0 to 25) do not."""
    head = load_head_assets(shared_dir / "subjects" / "head_model")
    pairs = lip_pairs(head)
    posed = head.template + head.expression_dirs.permute(2, 0, 1)[:57]
    gap = lip_gap(posed, pairs) - lip_gap(head.template[None], pairs)
    assert len(pairs) >= 8 and float(gap[:26].abs().max()) < 0.0005
    assert float(gap[[26, 27, 28, 29, 30, 35]].min()) > 0.004


def assert_opens_with_the_jaw(head: HeadAssets, millimetres_per_degree: float) -> None:
    pairs, model = lip_pairs(head), HeadModel(head, torch.zeros(0))
    assert len(pairs) >= 8
    degrees = torch.tensor([0.0, 2.0, 5.0, 10.0, 20.0])
    c, s, one, zero = degrees.deg2rad().cos(), degrees.deg2rad().sin(), torch.ones(5), torch.zeros(5)
    jaw = torch.stack((one, zero, zero, zero, c, -s, zero, s, c), dim=1).reshape(5, 3, 3)
    vertices = model.still_vertices(torch.zeros(5, 1), jaw, torch.arange(head.num_vertices))
    gap = 1000 * (lip_gap(vertices, pairs) - lip_gap(head.template[None], pairs))
    assert abs(float(gap[0])) < 0.01 and bool((gap[1:] > gap[:-1]).all())
    assert float(gap[3]) == pytest.approx(10 * millimetres_per_degree, rel=0.2)
