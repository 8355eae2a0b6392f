"""A head model as named tensors, as avatar files carry it along."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from heads import grid_head
from torch import Tensor

from avatar.head.head_tensors import head_from_tensors, head_tensors

HEAD = replace(grid_head(), layout_method=1)


def test_a_head_model_comes_back_from_its_tensors() -> None:
    found = head_from_tensors(head_tensors(HEAD))
    for name, tensor in head_tensors(HEAD).items():
        assert torch.equal(head_tensors(found)[name], tensor), name
    assert (found.parents, found.layout_method, set(found.regions)) == (HEAD.parents, 1, {"boundary", "lips"})
    assert found.fingerprint == head_from_tensors(head_tensors(found)).fingerprint


DAMAGES: dict[str, tuple[str, Tensor, str]] = {
    "a coordinate less": ("expression_dirs", HEAD.expression_dirs[:, :2], "expression_dirs must have shape"),
    "half the digits": ("template", HEAD.template.half(), "head.template is torch.float16, not torch.float32"),
    "faces in float": ("faces", HEAD.faces.float(), "head.faces is torch.float32, not torch.int64"),
    "not finite": ("weights", HEAD.weights / 0, "head.weights has 315 non-finite of 315"),
    "a face beyond the vertices": ("faces", HEAD.faces + 1, "head.faces names rows outside of 0 to 62"),
    "a face before them": ("faces", HEAD.faces - 1, "head.faces names rows outside of 0 to 62"),
    "a corner beyond the map": ("uv_faces", HEAD.uv_faces + 1, "head.uv_faces names rows outside of 0 to 62"),
    "a region beyond the vertices": ("region.lips", torch.tensor([63]), "head.region lips names rows outside"),
    "a region in float": ("region.lips", torch.tensor([1.0]), "head.region lips names rows outside"),
    "four joints": ("parents", torch.tensor([-1, 0, 1, 1]), "head.parents is"),
    "a root with a parent": ("parents", torch.tensor([0, 0, 1, 1, 1]), "head.parents is"),
    "a joint before its parent": ("parents", torch.tensor([-1, 1, 1, 1, 1]), "head.parents is"),
    "a joint of another root": ("parents", torch.tensor([-1, -1, 1, 1, 1]), "head.parents is"),
    "parents in float": ("parents", torch.tensor([-1, 0, 1, 0.5, 1]), "head.parents is"),
    "a method in float": ("layout_method", torch.tensor([1.0]), "head.layout_method is 1.0"),
    "two methods": ("layout_method", torch.tensor([1, 2]), "too many values"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_tensors_of_no_head_model_are_refused(name: str) -> None:
    key, tensor, sentence = DAMAGES[name]
    with pytest.raises((TypeError, ValueError), match=sentence):
        head_from_tensors(head_tensors(HEAD) | {key: tensor})


def test_a_region_without_vertices_is_kept() -> None:
    empty = torch.zeros(0, dtype=torch.int64)
    assert torch.equal(head_from_tensors(head_tensors(HEAD) | {"region.lips": empty}).regions["lips"], empty)
