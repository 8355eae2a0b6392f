from __future__ import annotations

import torch

from avatar.head.sample_image import sample_image


def test_nothing_is_sampled_outside_the_image_or_in_the_cameras_plane() -> None:
    image = torch.arange(12.0).reshape(3, 4, 1) + 1
    points = torch.tensor(
        [[0.5, 0.5, 1], [3.5, 2.5, 1], [2.0, 0.5, 1], [-5, 1, 1], [1, 99, 1], [1e30, 1, 1], [torch.inf, torch.nan, 0]]
    )
    expected = torch.tensor([1.0, 12.0, 2.5, 0.0, 0.0, 0.0, 0.0])
    torch.testing.assert_close(sample_image(image, points, "bilinear")[:, 0], expected, rtol=0, atol=1e-5)


def test_pictures_are_sampled_where_their_pixels_have_their_centres() -> None:
    columns, rows = torch.meshgrid(torch.arange(12.0), torch.arange(8.0), indexing="xy")
    picture = torch.stack((columns, rows), dim=2)
    places = torch.tensor([[0.5, 0.5, 1.0], [2.5, 6.5, 1.0], [11.25, 4.0, 1.0]])
    torch.testing.assert_close(sample_image(picture, places, "bilinear"), places[:, :2] - 0.5, rtol=0, atol=1e-4)
    nearest = sample_image(picture, torch.tensor([[1.2, 6.9, 1.0], [-0.1, 1.0, 1.0]]), "nearest")
    assert nearest.tolist() == [[1.0, 6.0], [0.0, 0.0]]
