"""A UV layout for a head model that comes without one, such as FLAME 2023 Open by itself.

The skin is cut open from the crown down the back of the head and laid into a disk, every vertex in the mean of its
neighbours by mean value weights (M. Floater, Mean value coordinates, CAGD 2003), so that no triangle overlaps another;
weights are then divided by how much the map stretches their vertex (S. Yoshizawa, A. Belyaev and H.-P. Seidel, A fast and
simple stretch-minimizing mesh parameterization, SMI 2004), some times over. The front is laid out larger. Other parts,
the eyeballs, lie in the corners, seen from in front (Lambert's equal-area projection).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import splu

LAYOUT_METHOD = 1  # raised when the same mesh is laid out otherwise: avatars are bound to the layout
ROUNDS, EXPONENT = 5, 0.7  # of the division by the stretch; later rounds stretch the rest for the nostrils' sake
FRONT_GAIN = 2.5  # times the area that the back has
FRONT, BACK = 1.0, 1.5  # radians from the line through the face: within the first, and beyond the second
RADIUS, CORNER_RADIUS, CORNER = 0.49, 0.08, 0.09  # of the disk, of a part in a corner, and of that part's centre
DIGITS = 5  # of the coordinates
# Where the head's middle is, in distances of the eyes from their own.
_MIDDLE = np.array([0.0, -0.3, -1.06])
_ASIDE, _IN_FRONT = 20.0, 50.0  # what the cut costs off the middle and on the face, in its own length
_ON_THE_LEFT = 1e-6  # of a mirrored way, so that rounding does not decide between them
_MIN_TANGENT, _MAX_TANGENT = 1e-3, 1e3  # of half an angle of a triangle: degenerate ones
_NOTHING = 1e-12


class NoLayout(ValueError):
    """The mesh is not one that can be laid out."""


class _Frame(NamedTuple):
    middle: np.ndarray  # of the head
    unit: float  # the distance between the eyes


def unwrap(
    template: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], eyes: Float[np.ndarray, "2 3"]
) -> tuple[Float[np.ndarray, "T 2"], Int[np.ndarray, "F 3"]]:
    """UVs (0 to 1, origin at the lower left) and, for each face, the rows of its corners.

    `eyes` are the centres of the eyeballs; y is up and z is where the face looks to. Raises `NoLayout` where the largest
    part of the mesh is no skin that a cut turns into a disk.
    """
    points = template.astype(np.float64)
    unit = float(np.linalg.norm(eyes[0] - eyes[1]))
    if not unit > 0.0:
        raise NoLayout("the joints of both eyes are in one place")
    frame = _Frame(eyes.astype(np.float64).mean(0) + unit * _MIDDLE, unit)
    of_vertex = connected_components(_graph(np.ones(3 * len(faces)), _edges(faces), len(points)), directed=False)[1]
    part = of_vertex[faces[:, 0]]
    skin = np.bincount(part).argmax()
    uvs, uv_faces = np.zeros((1, 2)), np.zeros(faces.shape, np.int64)  # row 0 is where triangles without area go

    def place(chosen: Bool[np.ndarray, " F"], coordinates: np.ndarray, corners: np.ndarray) -> None:
        nonlocal uvs
        uv_faces[chosen] = np.where(corners < 0, 0, corners + len(uvs))
        uvs = np.concatenate((uvs, coordinates))

    place(part == skin, *_disk(points, faces[part == skin], frame))
    others = [name for name in np.unique(part) if name != skin]
    others.sort(key=lambda name: (-np.sum(part == name), points[faces[part == name]][..., 0].mean()))
    for name, (centre, radius) in zip(others, _slots(len(others)), strict=True):
        place(part == name, *_seen_from_in_front(points, faces[part == name], centre, radius))
    if not ((uvs >= 0.0) & (uvs <= 1.0)).all():  # NaN is not either
        raise NoLayout("its triangles are degenerate")
    return np.round(uvs, DIGITS).astype(np.float32), uv_faces


def _disk(
    points: np.ndarray, faces: np.ndarray, frame: _Frame
) -> tuple[Float[np.ndarray, "T 2"], Int[np.ndarray, "F 3"]]:
    """The skin, cut and laid into the disk."""
    crown, cut = _cut_line(points, faces, frame)
    corners, vertex_of = _cut_open(faces, cut)
    loops = _loops(corners)
    if not loops:
        raise NoLayout("a cut does not open its largest part")
    places = points[vertex_of]
    outer = max(loops, key=lambda loop: _length(places[loop]))
    rim = np.array(outer)
    # Other holes, such as the mouth, are closed by a point in their middle.
    holes = [loop for loop in loops if loop is not outer]
    middles = [places[loop].mean(0, keepdims=True) for loop in holes]
    fans = [
        [[after, before, len(places) + n] for before, after in zip(loop, [*loop[1:], loop[0]], strict=True)]
        for n, loop in enumerate(holes)
    ]
    closed = np.concatenate([corners, *(np.array(fan) for fan in fans)])
    closed_places = np.concatenate([places, *middles])
    if len(closed_places) - len(np.unique(np.sort(_edges(closed), axis=1), axis=0)) + len(closed) != 1:
        raise NoLayout("cut open, its largest part is no disk")
    distances = np.linalg.norm(places[rim] - np.roll(places[rim], 1, axis=0), axis=1)
    share = np.cumsum(distances) / distances.sum()
    first = int(np.argmin(np.linalg.norm(places[rim] - points[crown], axis=1)))
    angle = 2.0 * np.pi * (share - share[first]) + 0.5 * np.pi  # the crown on top
    circle = 0.5 + RADIUS * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    laid = _least_stretched(closed_places, closed, rim, circle, _gain(closed_places, frame))
    return laid[: len(places)], corners


def _cut_line(points: np.ndarray, faces: np.ndarray, frame: _Frame) -> tuple[int, Int[np.ndarray, "E 2"]]:
    """The crown, and the edges of the shortest way from there to the lowest hole, down the middle of the back."""
    edges = np.unique(np.sort(_edges(faces), axis=1), axis=0)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    place = points[edges].mean(1) - frame.middle
    aside = _ASIDE * np.abs(place[:, 0]) / frame.unit
    extra = np.where(place[:, 2] > 0.0, _IN_FRONT, 0.0) + np.where(place[:, 0] > 0.0, _ON_THE_LEFT, 0.0)
    cost = np.maximum(length * (1.0 + aside + extra), _NOTHING)
    skin = np.unique(faces)
    offset = points[skin] - frame.middle
    crown = int(skin[np.argmax(offset[:, 1] - 5.0 * np.abs(offset[:, 0]) - np.abs(offset[:, 2]))])
    distance, before = dijkstra(
        _graph(cost, edges, len(points)), directed=False, indices=crown, return_predecessors=True
    )
    loops = _loops(faces) if _is_manifold(faces) else []
    lowest = min(loops, key=lambda loop: points[loop, 1].mean(), default=[])
    behind = [int(skin[np.argmin(offset[:, 1] + offset[:, 2])])]  # of a skin without a hole
    at = min(lowest or behind, key=lambda vertex: distance[vertex])
    if not np.isfinite(distance[at]) or at == crown:
        raise NoLayout("no way leads from the crown down the back")
    way = [at]
    while way[-1] != crown:
        way.append(int(before[way[-1]]))
    return crown, np.stack((way[:-1], way[1:]), axis=1)


def _cut_open(faces: np.ndarray, cut: Int[np.ndarray, "E 2"]) -> tuple[Int[np.ndarray, "F 3"], Int[np.ndarray, " T"]]:
    """Corners that share an edge which is not cut share a row: the rows of each face, and the vertex of each row."""
    corner = np.arange(faces.size).reshape(faces.shape)
    sides = np.concatenate(
        [np.stack((faces[:, k], faces[:, (k + 1) % 3], corner[:, k], corner[:, (k + 1) % 3]), axis=1) for k in range(3)]
    )
    name, cut_names = _edge_names(sides[:, :2]), _edge_names(cut)
    order = np.argsort(name, kind="stable")
    sides, name = sides[order], name[order]
    if (name[2:] == name[:-2]).any():
        raise NoLayout("more than two triangles meet in an edge")
    pairs = np.flatnonzero((name[1:] == name[:-1]) & ~np.isin(name[1:], cut_names))
    one, other = sides[pairs], sides[pairs + 1]
    if (one[:, 0] != other[:, 1]).any():
        raise NoLayout("neighbouring triangles turn opposite ways")
    same = np.concatenate((np.stack((one[:, 2], other[:, 3]), axis=1), np.stack((one[:, 3], other[:, 2]), axis=1)))
    count, rows = connected_components(_graph(np.ones(len(same)), same, faces.size), directed=False)
    vertex_of = np.zeros(count, np.int64)
    vertex_of[rows] = faces.ravel()
    return rows.reshape(faces.shape).astype(np.int64), vertex_of


def _least_stretched(
    points: np.ndarray, faces: np.ndarray, rim: np.ndarray, circle: np.ndarray, gain: np.ndarray
) -> Float[np.ndarray, "T 2"]:
    """Every vertex but the rim's in the weighted mean of its neighbours; `gain` is how much larger its area shall be."""
    corners = points[faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.maximum(0.5 * np.linalg.norm(np.cross(first, second), axis=1), _NOTHING)
    own_gain = gain[faces].mean(1)
    wanted = csr_matrix(  # the area of each triangle, at its corners
        (np.repeat(area * own_gain, 3), (faces.ravel(), np.repeat(np.arange(len(faces)), 3))), (len(points), len(faces))
    )
    # The triangle in its own plane: first edge along x.
    base = np.maximum(np.linalg.norm(first, axis=1), _NOTHING)
    scale = np.sqrt(own_gain)
    flat = scale[:, None] * np.stack((base, (first * second).sum(1) / base, 2.0 * area / base), axis=1)
    weights = _mean_value_weights(points, faces)
    inside = np.setdiff1d(np.arange(len(points)), rim)
    laid = np.zeros((len(points), 2))
    laid[rim] = circle
    for _ in range(ROUNDS):
        laplacian = csr_matrix(diags(np.asarray(weights.sum(1)).ravel()) - weights)[inside]
        try:
            laid[inside] = splu(laplacian[:, inside].tocsc()).solve(-(laplacian[:, rim] @ circle))
        except RuntimeError as error:
            raise NoLayout(f"its triangles are degenerate ({error})") from None
        stretch = _squared_stretch(flat, laid[faces])
        mean = (wanted @ stretch) / np.maximum(np.asarray(wanted.sum(1)).ravel(), _NOTHING)
        weights = weights @ diags(1.0 / np.maximum(np.sqrt(mean), _NOTHING) ** EXPONENT)
    return laid


def _squared_stretch(flat: Float[np.ndarray, "F 3"], laid: Float[np.ndarray, "F 3 2"]) -> Float[np.ndarray, " F"]:
    """Mean square over all directions of length on the mesh by length in the layout, but for a common factor.

    `flat` are x of the second corner, and x and y of the third, in the triangle's plane.
    """
    u, w = laid[:, 1] - laid[:, 0], laid[:, 2] - laid[:, 0]
    twice = u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]
    twice = np.where(np.abs(twice) < _NOTHING, _NOTHING, twice)
    x, x2, y2 = flat.T
    along_u = np.stack((x * w[:, 1] - x2 * u[:, 1], -y2 * u[:, 1]), axis=1) / twice[:, None]
    along_v = np.stack((-x * w[:, 0] + x2 * u[:, 0], y2 * u[:, 0]), axis=1) / twice[:, None]
    return 0.5 * ((along_u**2).sum(1) + (along_v**2).sum(1))


def _mean_value_weights(points: np.ndarray, faces: np.ndarray) -> csr_matrix:
    rows, columns, values = [], [], []
    for k in range(3):
        at, one, other = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        first, second = points[one] - points[at], points[other] - points[at]
        lengths = [np.maximum(np.linalg.norm(side, axis=1), _NOTHING) for side in (first, second)]
        cosine = np.clip((first * second).sum(1) / (lengths[0] * lengths[1]), -1.0, 1.0)
        tangent = np.clip(np.tan(0.5 * np.arccos(cosine)), _MIN_TANGENT, _MAX_TANGENT)
        rows += [at, at]
        columns += [one, other]
        values += [tangent / length for length in lengths]
    shape = (len(points), len(points))
    return csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape)


def _gain(points: np.ndarray, frame: _Frame) -> Float[np.ndarray, " V"]:
    direction = points - frame.middle
    cosine = direction[:, 2] / np.maximum(np.linalg.norm(direction, axis=1), _NOTHING)
    return 1.0 + (FRONT_GAIN - 1.0) * np.clip((BACK - np.arccos(np.clip(cosine, -1.0, 1.0))) / (BACK - FRONT), 0.0, 1.0)


def _seen_from_in_front(
    points: np.ndarray, faces: np.ndarray, centre: tuple[float, float], radius: float
) -> tuple[Float[np.ndarray, "T 2"], Int[np.ndarray, "F 3"]]:
    """A round part; triangles that the projection turns over, at its back, get no area (-1)."""
    vertices, rows = np.unique(faces, return_inverse=True)
    rows = rows.reshape(faces.shape)
    direction = points[vertices] - points[vertices].mean(0)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), _NOTHING)
    polar = np.arccos(np.clip(direction[:, 2], -1.0, 1.0))
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    laid = radius * np.sin(0.5 * polar)[:, None] * np.stack((np.cos(azimuth), np.sin(azimuth)), axis=1)
    u, w = laid[rows[:, 1]] - laid[rows[:, 0]], laid[rows[:, 2]] - laid[rows[:, 0]]
    is_over = u[:, 0] * w[:, 1] <= u[:, 1] * w[:, 0]
    return laid + np.array(centre), np.where(is_over[:, None], -1, rows)


def _slots(count: int) -> list[tuple[tuple[float, float], float]]:
    """Centres and radii for so many parts, in the corners: one in each, or a grid where there are more than four."""
    side = max(1, int(np.ceil(np.sqrt(count / 4.0))))
    half = CORNER_RADIUS if side == 1 else CORNER_RADIUS / np.sqrt(2.0)  # of the corner's square
    steps = [half * ((2 * k + 1) / side - 1.0) for k in range(side)]
    corners = [(CORNER, 1.0 - CORNER), (1.0 - CORNER, 1.0 - CORNER), (CORNER, CORNER), (1.0 - CORNER, CORNER)]
    cells = [((x + dx, y + dy), half / side) for dy in steps for dx in steps for x, y in corners]
    return cells[:count]


def _loops(faces: Int[np.ndarray, "F 3"]) -> list[list[int]]:
    """The holes' vertices in their order, round the mesh."""
    sides = [(int(a), int(b)) for a, b in _edges(faces)]
    known = set(sides)
    following = {a: b for a, b in sides if (b, a) not in known}
    loops = []
    while following:
        start, at = following.popitem()
        loop = [start]
        while at != start:
            loop.append(at)
            if at not in following:
                raise NoLayout("its holes touch")
            at = following.pop(at)
        loops.append(loop)
    return loops


def _is_manifold(faces: np.ndarray) -> bool:
    """Whether no two holes touch in a vertex, so that `_loops` can tell them apart."""
    sides = _edges(faces)
    known = {(int(a), int(b)) for a, b in sides}
    starts = [a for a, b in known if (b, a) not in known]
    return len(starts) == len(set(starts))


def _length(loop: Float[np.ndarray, "N 3"]) -> float:
    return float(np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).sum())


def _edges(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "3*F 2"]:
    return np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))


def _edge_names(edges: Int[np.ndarray, "E 2"]) -> Int[np.ndarray, " E"]:
    """One number for each edge, whichever way it goes."""
    return edges.min(axis=1).astype(np.int64) * 2**31 + edges.max(axis=1)


def _graph(weights: Float[np.ndarray, " E"], edges: Int[np.ndarray, "E 2"], count: int) -> csr_matrix:
    return csr_matrix(coo_matrix((weights, (edges[:, 0], edges[:, 1])), shape=(count, count)))
