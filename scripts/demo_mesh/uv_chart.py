"""The chart of the demo head's skin: longitude and latitude about `RAY_ORIGIN`, warped to give the face most of it."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator

from demo_mesh.sculpt import RAY_ORIGIN, cast, cast_front

V_RIM, V_CROWN = 0.008, 0.992
_U_OF_DEGREES = PchipInterpolator((0, 20, 45, 70, 90, 130, 180), (0.0, 0.25, 0.53, 0.745, 0.835, 0.92, 1.0))
HALF_WIDTH = PchipInterpolator((0.0, 0.70, 0.80, 0.88, 1.0), (0.492, 0.492, 0.45, 0.365, 0.2))


class SkinChart:
    """The one-to-one map between directions from `RAY_ORIGIN` and the UV square."""

    def __init__(self) -> None:
        longitude = np.radians(np.linspace(0.0, 180.0, 37))
        latitude = np.radians(np.linspace(-84.0, -35.0, 90))
        grid = cast(RAY_ORIGIN, directions(*np.meshgrid(longitude, latitude, indexing="ij")).reshape(-1, 3))
        grid = grid.reshape(37, 90, 3)
        above_rim = grid[..., 1] + 155.0 + 0.27 * grid[..., 2]  # the neck ends in this plane
        lowest = np.array([np.interp(0.0, row, latitude) for row in above_rim])
        # A few cosines: an open end without the waves of the neck's tendons.
        order = np.arange(4)
        self._lowest_cosines = np.linalg.lstsq(np.cos(longitude[:, None] * order), lowest, rcond=None)[0]
        marks = cast_front(np.stack((np.zeros(6), (-88.0, -47.5, -27.0, 22.0, 42.0, 92.0)), -1)) - RAY_ORIGIN
        height = self._height(np.zeros(6), np.arctan2(marks[:, 1], marks[:, 2]))
        self._v_of_height = PchipInterpolator(
            (0.0, 0.065, *height, 1.0), (V_RIM, 0.08, 0.145, 0.315, 0.42, 0.625, 0.715, 0.86, V_CROWN)
        )

    def _lowest(self, longitude: np.ndarray) -> np.ndarray:
        return np.cos(longitude[..., None] * np.arange(4)) @ self._lowest_cosines

    def _height(self, longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
        lowest = self._lowest(longitude)
        return (latitude - lowest) / (np.pi / 2 - lowest)

    def uv(self, points: np.ndarray) -> np.ndarray:
        """UV [..., 2] of points [..., 3] in millimetres on the smooth head surface."""
        d = points - RAY_ORIGIN
        longitude = np.arctan2(d[..., 0], d[..., 2])
        v = self._v_of_height(self._height(longitude, np.arctan2(d[..., 1], np.hypot(d[..., 0], d[..., 2]))))
        across = np.sign(longitude) * _U_OF_DEGREES(np.degrees(np.abs(longitude)))
        return np.stack((0.5 + across * HALF_WIDTH(v), v), -1)

    def neck_share(self, uv: np.ndarray) -> np.ndarray:
        """0 above the jaw, 1 at the open end of the neck, for UV [..., 2]."""
        return np.clip(1.0 - uv[..., 1] / 0.12, 0.0, 1.0)

    def directions(self, uv: np.ndarray) -> np.ndarray:
        """Unit directions [..., 3] from `RAY_ORIGIN` of UV [..., 2]."""
        table = np.linspace(0.0, 1.0, 4001)
        height = np.interp(uv[..., 1], self._v_of_height(table), table)
        across = np.clip((uv[..., 0] - 0.5) / HALF_WIDTH(uv[..., 1]), -1.0, 1.0)
        longitude = np.radians(np.interp(np.abs(across), _U_OF_DEGREES(table * 180.0), table * 180.0))
        lowest = self._lowest(longitude)
        return directions(np.sign(across) * longitude, lowest + height * (np.pi / 2 - lowest))


def directions(longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
    return np.stack((np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)), -1)
