"""The mesh of the demo head: one skin chart that covers the face generously, and two discs for the eyeballs.

The chart is longitude and latitude about `RAY_ORIGIN`, warped so that the face takes most of it, with the cut down the
back of the head and the crown at the top, where it narrows to leave its corners to the eyeballs. The left half is
triangulated (feature rings, and a centroidal Voronoi arrangement of vertices between them) and mirrored.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay, KDTree
from skimage.measure import points_in_poly

from avatar.demo.mesh import EYE_CENTRE, EYE_RADIUS, HeadMesh
from demo_mesh.features import Rings, ear_rings, eye_rings, mouth_rings
from demo_mesh.sculpt import RAY_ORIGIN, cast
from demo_mesh.uv_chart import HALF_WIDTH, V_CROWN, V_RIM, SkinChart, directions

EYE_DISC_CENTRE, EYE_DISC_RADIUS = np.array([0.932, 0.932]), 0.062  # left eyeball; u is mirrored for the right
EYEBALL_RINGS, EYEBALL_SECTORS, EYEBALL_REACH = 11, 24, np.radians(112.0)
LLOYD_STEPS = 40
NECK_STRETCH = 1.6


def _spacing(points: np.ndarray) -> np.ndarray:
    """Wanted edge length [N] in millimetres at surface points [N, 3] of the left half."""
    on_nose = points - np.array([0.0, 0.0, 96.0])
    on_nose[:, 1] -= np.clip(points[:, 1], -24.0, 10.0)
    wanted = np.full(len(points), 10.0)
    for offset, finest, reach in (
        (on_nose, 2.4, 14.0),
        (points - EYE_CENTRE, 3.2, 20.0),
        (points - np.array([0.0, -47.5, 88.0]), 3.4, 32.0),
        (points - np.array([76.0, 4.0, -11.0]), 5.0, 34.0),
    ):
        distance = np.linalg.norm(offset, axis=-1)
        wanted = np.minimum(wanted, finest + 0.11 * np.maximum(distance - reach, 0.0))
    return wanted


def _along(line: np.ndarray) -> np.ndarray:
    """Parameters in [0, 1] (both ends included) that put vertices at the wanted spacing on a polyline [N, 3]."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=-1) / _spacing(0.5 * (line[1:] + line[:-1]))
    run = np.concatenate(([0.0], np.cumsum(steps)))
    count = max(round(float(run[-1])), 1)
    return np.interp(np.linspace(0.0, run[-1], count + 1), run, np.linspace(0.0, 1.0, len(line)))


def _edge(chart: SkinChart, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """UV points [N, 2] along a straight line of the `across, v` coordinates, ends included."""

    def at(t: np.ndarray) -> np.ndarray:
        line = start + t[:, None] * (end - start)
        return np.stack((0.5 + line[:, 0] * HALF_WIDTH(line[:, 1]), line[:, 1]), -1)

    dense = cast(RAY_ORIGIN, chart.directions(at(np.linspace(0.0, 1.0, 160))))
    return at(_along(dense))


def _fill(chart: SkinChart, fixed_uv: np.ndarray, outlines: list[np.ndarray]) -> np.ndarray:
    """Vertices [N, 2] between the fixed ones: Lloyd's algorithm on surface samples weighted by the wanted density."""
    side = np.linspace(0.0, 1.0, 190)
    across, v = np.meshgrid(side, V_RIM + side * (V_CROWN - V_RIM))
    uv = np.stack((0.5 + across * HALF_WIDTH(v), v), -1)
    points = cast(RAY_ORIGIN, chart.directions(uv.reshape(-1, 2))).reshape(*v.shape, 3)
    centre = points[:-1, :-1] + points[1:, 1:] + points[:-1, 1:] + points[1:, :-1]
    area = np.linalg.norm(np.cross(points[1:, 1:] - points[:-1, :-1], points[:-1, 1:] - points[1:, :-1]), axis=-1) / 2
    samples = centre.reshape(-1, 3) / 4.0
    weight = area.reshape(-1) / (0.5 * np.sqrt(3.0) * _spacing(samples) ** 2)
    sample_uv = chart.uv(samples)
    free = ~np.any([points_in_poly(sample_uv, outline) for outline in outlines], axis=0)
    free &= samples[:, 0] > 0.45 * _spacing(samples)  # nor close to the midline and the seam
    samples, weight, sample_uv = samples[free], weight[free], sample_uv[free]

    fixed = cast(RAY_ORIGIN, chart.directions(fixed_uv))
    count = int(weight.sum() - 0.5 * len(fixed_uv) * 0.35)
    generator = np.random.default_rng(5)
    sites = samples[generator.choice(len(samples), count, replace=False, p=weight / weight.sum())]
    for _ in range(LLOYD_STEPS):
        _, nearest = KDTree(np.concatenate((fixed, sites))).query(samples)
        nearest = np.asarray(nearest) - len(fixed)
        own = nearest >= 0
        mass = np.bincount(nearest[own], weight[own], count)
        moved = [np.bincount(nearest[own], weight[own] * samples[own, k], count) for k in range(3)]
        sites = np.where(mass[:, None] > 0, np.stack(moved, -1) / np.maximum(mass, 1e-12)[:, None], sites)
    return chart.uv(sites)


def _ring_indices(rings: Rings, start: int) -> np.ndarray:
    return start + np.arange(rings.position[..., 0].size).reshape(rings.position.shape[:2])


def build_head_mesh() -> HeadMesh:
    """The whole mesh; deterministic, about three seconds."""
    chart = SkinChart()
    features = (eye_rings(), mouth_rings(), ear_rings())
    eye, mouth, ear = features
    ring_uv = [chart.uv(r.chart) for r in features]
    mouth_top, mouth_bottom = ring_uv[1][-1, 0, 1], ring_uv[1][-1, -1, 1]
    edges = [
        _edge(chart, np.array([0.0, V_RIM]), np.array([0.0, mouth_bottom]))[:-1],
        _edge(chart, np.array([0.0, mouth_top]), np.array([0.0, V_CROWN]))[1:],
        _edge(chart, np.array([0.0, V_RIM]), np.array([1.0, V_RIM]))[1:],
        _edge(chart, np.array([1.0, V_RIM]), np.array([1.0, V_CROWN]))[1:-1],
    ]
    # Vertices in between keep a little away from the rings' edges.
    eye_line, mouth_line, ear_line = (r[-1] + 0.1 * (r[-1] - r[-1].mean(0)) for r in ring_uv)
    mouth_line = np.concatenate((mouth_line, [[0.4, mouth_line[-1, 1]], [0.4, mouth_line[0, 1]]]))
    outlines = [eye_line, mouth_line, ear_line]
    fixed_uv = np.concatenate((*[r[-1] for r in ring_uv], *edges))
    free_uv = np.concatenate((*edges, _fill(chart, fixed_uv, outlines)))
    ring_index = [_ring_indices(eye, 0)]
    ring_index.append(_ring_indices(mouth, ring_index[0].size))
    ring_index.append(_ring_indices(ear, ring_index[0].size + ring_index[1].size))
    uv = np.concatenate((*[r.reshape(-1, 2) for r in ring_uv], free_uv))
    half = np.concatenate((*[r.position.reshape(-1, 3) for r in features], cast(RAY_ORIGIN, chart.directions(free_uv))))
    uv[np.abs(uv[:, 0] - 0.5) < 1e-9, 0] = 0.5
    half[uv[:, 0] == 0.5, 0] = 0.0

    outer = [index[-1] for index in ring_index]
    around = np.concatenate((*outer, np.arange(len(uv) - len(free_uv), len(uv))))
    starts = np.cumsum([0] + [len(ring) for ring in outer])
    rings = [(np.arange(i, j), r.closed) for i, j, r in zip(starts[:-1], starts[1:], features, strict=True)]
    triangles = around[_triangulate(chart, uv[around], rings)]
    strips = [_strips(index, r.closed) for index, r in zip(ring_index, features, strict=True)]
    triangles = np.concatenate((triangles, *strips, _closing(ring_index[2][0])))
    a, b, c = (uv[triangles[:, k]] for k in range(3))
    clockwise = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    triangles[clockwise] = triangles[clockwise, ::-1]
    return _assemble(uv, half, triangles, ring_index)


def _strips(index: np.ndarray, closed: bool) -> np.ndarray:
    """Triangles [F, 3], of either winding, between each of the rings [R, K] and the next."""
    if closed:
        index = np.concatenate((index, index[:, :1]), -1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    quads = np.stack((a, b, c, d), -1).reshape(-1, 4)
    return np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))


def _closing(ring: np.ndarray) -> np.ndarray:
    """Triangles [F, 3], of either winding, that fill a ring by joining opposite points."""
    count = len(ring)
    up, down = ring[: count // 2 + 1], np.concatenate((ring[:1], ring[: count // 2 - 1 : -1]))
    faces = np.stack((up[:-1], up[1:], down[1:]), -1), np.stack((up[:-1], down[1:], down[:-1]), -1)
    triangles = np.concatenate(faces)
    return triangles[(triangles != np.roll(triangles, 1, axis=1)).all(1)]


def _triangulate(chart: SkinChart, uv: np.ndarray, rings: list[tuple[np.ndarray, bool]]) -> np.ndarray:
    """Delaunay triangles [F, 3] of the left half outside the rings (vertex indices, whether closed).

    On a stereographic disc, where angles are nearly those of the surface. Seen from `RAY_ORIGIN` the neck is
    foreshortened; it is drawn out first, in Mercator's latitude.
    """
    d = chart.directions(uv)
    latitude = np.arcsin(np.clip(d[:, 1], -1.0, 1.0))
    mercator = np.arcsinh(np.tan(np.clip(latitude, -1.55, 1.55))) - NECK_STRETCH * chart.neck_share(uv)
    stretched = np.where(chart.neck_share(uv) > 0, np.arctan(np.sinh(mercator)), latitude)
    d = directions(np.arctan2(d[:, 0], d[:, 2]), stretched)
    disc = d[:, 1:] / (1.0 + d[:, :1])
    guards = []  # a point inside each ring edge makes the edge Delaunay
    for ring, closed in rings:
        a, b = disc[ring], disc[np.roll(ring, -1)]
        a, b = (a, b) if closed else (a[:-1], b[:-1])
        inward = np.stack((a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]), -1)
        inward *= np.sign(((disc[ring].mean(0) - a) * inward).sum(-1, keepdims=True))
        guards.append(0.5 * (a + b) + 0.8 * inward)
    triangles = Delaunay(np.concatenate((disc, *guards))).simplices
    triangles = triangles[(triangles < len(uv)).all(1)]
    for ring, _ in rings:
        triangles = triangles[~points_in_poly(disc[triangles].mean(1), disc[ring])]
    rim = np.abs(uv[:, 1] - V_RIM) < 1e-9
    triangles = triangles[rim[triangles].sum(1) < 3]
    a, b, c = (d[triangles[:, k]] for k in range(3))
    return triangles[np.abs((np.cross(b - a, c - a) * (a + b + c)).sum(-1)) > 1e-9]


def _assemble(uv: np.ndarray, half: np.ndarray, triangles: np.ndarray, rings: list[np.ndarray]) -> HeadMesh:
    """Mirror the left half, join it along the midline and the back seam, give the crown its UVs, add the eyeballs."""
    n = len(half)
    on_midline = uv[:, 0] == 0.5
    on_seam = np.abs(uv[:, 0] - 0.5 - HALF_WIDTH(uv[:, 1])) < 1e-9
    half[on_seam, 0] = 0.0
    right = np.where(on_midline | on_seam, np.arange(n), n + np.arange(n))
    right_uv = np.where(on_midline, np.arange(n), n + np.arange(n))

    # All longitudes meet in the crown: each of its triangles gets a UV vertex of its own, above its other two.
    crown = int(np.flatnonzero(on_midline & (np.abs(uv[:, 1] - V_CROWN) < 1e-9))[0])
    uv_triangles, extra = triangles.copy(), []
    for f in np.flatnonzero((triangles == crown).any(1)):
        others = uv[triangles[f][triangles[f] != crown]]
        across = ((others[:, 0] - 0.5) / HALF_WIDTH(others[:, 1])).mean()
        uv_triangles[f][triangles[f] == crown] = 2 * n + len(extra)
        extra.append((0.5 + across * float(HALF_WIDTH(V_CROWN)), V_CROWN))
    extra_uv = np.array(extra)
    right_uv = np.concatenate((right_uv, np.full(n, -1), 2 * n + len(extra) + np.arange(len(extra))))

    faces = np.concatenate((triangles, right[triangles][:, ::-1]))
    uv_faces = np.concatenate((uv_triangles, right_uv[uv_triangles][:, ::-1]))
    points = np.concatenate((half, half * np.array([-1.0, 1.0, 1.0])))
    flipped = np.array([-1.0, 1.0])
    uvs = np.concatenate((uv, uv * flipped + [1.0, 0.0], extra_uv, extra_uv * flipped + [1.0, 0.0]))
    mirror = np.concatenate((right, np.arange(n)))

    ball, ball_uv, ball_faces = _eyeball()
    eyeballs = []
    for flip in (1.0, -1.0):
        start, uv_start = len(points), len(uvs)
        points = np.concatenate((points, (ball + EYE_CENTRE) * np.array([flip, 1.0, 1.0])))
        placed = EYE_DISC_CENTRE + EYE_DISC_RADIUS * ball_uv
        uvs = np.concatenate((uvs, placed if flip > 0 else placed * flipped + [1.0, 0.0]))
        order = ball_faces if flip > 0 else ball_faces[:, ::-1]
        faces, uv_faces = np.concatenate((faces, order + start)), np.concatenate((uv_faces, order + uv_start))
        eyeballs.append(np.arange(start, start + len(ball)))
    mirror = np.concatenate((mirror, eyeballs[1], eyeballs[0]))

    used, faces = np.unique(faces, return_inverse=True)
    new = np.full(len(points), -1)
    new[used] = np.arange(len(used))
    used_uv, uv_faces = np.unique(uv_faces, return_inverse=True)
    bottom = np.flatnonzero(np.abs(uv[:, 1] - V_RIM) < 1e-9)
    eye, mouth, ear = (np.stack((new[r], new[right[r]])) for r in rings)
    return HeadMesh(
        vertices=points[used] * 1e-3,
        faces=faces.reshape(-1, 3).astype(np.int32),
        uvs=uvs[used_uv],
        uv_faces=uv_faces.reshape(-1, 3).astype(np.int32),
        mirror=new[mirror[used]],
        eye_rings=eye,
        mouth_rings=mouth,
        ear_rings=ear,
        eyeballs=new[np.array(eyeballs)],
        rim=np.unique(new[np.concatenate((bottom, right[bottom]))]),
    )


def _eyeball() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [N, 3] in millimetres about the centre, disc UV in the unit circle and faces; the pupil is at +z."""
    polar = EYEBALL_REACH * (np.arange(1, EYEBALL_RINGS + 1) / EYEBALL_RINGS)
    turn = np.arange(EYEBALL_SECTORS) * (2 * np.pi / EYEBALL_SECTORS)
    p, t = np.meshgrid(polar, turn, indexing="ij")
    rim = np.stack((np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)), -1).reshape(-1, 3)
    points = np.concatenate(([[0.0, 0.0, 1.0]], rim)) * EYE_RADIUS
    disc = np.concatenate(([[0.0, 0.0]], np.stack((p * np.cos(t), p * np.sin(t)), -1).reshape(-1, 2) / EYEBALL_REACH))
    faces = []
    for s in range(EYEBALL_SECTORS):
        s1 = (s + 1) % EYEBALL_SECTORS
        faces.append((0, 1 + s, 1 + s1))
        for r in range(EYEBALL_RINGS - 1):
            a, b = 1 + r * EYEBALL_SECTORS + s, 1 + r * EYEBALL_SECTORS + s1
            c, d = a + EYEBALL_SECTORS, b + EYEBALL_SECTORS
            faces += [(a, c, d), (a, d, b)]
    return points, disc, np.array(faces)
