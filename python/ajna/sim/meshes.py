# SPDX-License-Identifier: MIT
"""Low-polygon surfaces with texture coordinates, made of numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Mesh", "box", "icosphere", "lumpy", "merged", "perforated_wall", "sector_prisms", "tube"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Mesh:
    """Vertices [V, 3] in metres, texture [V, 2] (1 = a tile), triangles [F, 3] (counterclockwise outside)."""

    vertices: Floats
    texcoords: Floats
    faces: NDArray[np.int32]

    def moved(self, offset: Sequence[float] | Floats, rotation: Floats | None = None) -> Mesh:
        """Rotated ([3, 3]) about the origin, then moved."""
        turned = self.vertices if rotation is None else self.vertices @ rotation.T
        return Mesh(turned + np.asarray(offset), self.texcoords, self.faces)


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """All in one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.texcoords for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]).astype(np.int32),
    )


def _grid_faces(rows: int, columns: int) -> NDArray[np.int32]:
    """Two triangles per cell of a grid of vertices [rows, columns]."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)


def tube(path: Floats, radii: NDArray[np.floating], sides: int = 10, tile_m: float = 0.5, cap: bool = True) -> Mesh:
    """A tube along points [N, 3] with a radius at each; the texture repeats every ``tile_m`` metres."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    helper = np.where(np.abs(tangent[:, :1]) < 0.9, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]))
    u = np.cross(tangent, np.cross(helper, tangent))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(tangent, u)
    angle = np.linspace(0, 2 * np.pi, sides + 1)  # the seam has two vertices, with the texture's two ends
    ring = u[:, None] * np.cos(angle)[None, :, None] + v[:, None] * np.sin(angle)[None, :, None]
    vertices = path[:, None] + radii[:, None, None] * ring
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    around = max(1, round(2 * np.pi * float(radii.max()) / tile_m))  # a whole number of tiles: no seam
    texture = np.stack(np.broadcast_arrays(angle[None] / (2 * np.pi) * around, along[:, None] / tile_m), -1)
    body = Mesh(vertices.reshape(-1, 3), texture.reshape(-1, 2), _grid_faces(len(path), sides + 1))
    if not cap:
        return body
    parts = [body]
    for end, flip in ((0, True), (-1, False)):
        rim = vertices[end, :-1]
        points = np.concatenate([path[end][None], rim])
        i = np.arange(sides)
        fan = np.stack([np.zeros_like(i), 1 + i, 1 + (i + 1) % sides], 1)
        flat = np.stack([(points - path[end]) @ u[end], (points - path[end]) @ v[end]], 1) / tile_m
        parts.append(Mesh(points, flat, (fan[:, ::-1] if flip else fan).astype(np.int32)))
    return merged(parts)


def box(size: Sequence[float] | Floats, tile_m: float = 0.5) -> Mesh:
    """A box of the full side lengths ``size``, centred at the origin."""
    parts = []
    half = np.asarray(size, float) / 2
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = sign * half[axis]
            corners[:, a] = np.array([-1, 1, 1, -1]) * half[a]
            corners[:, b] = np.array([-1, -1, 1, 1]) * half[b]
            # v runs along z on the sides
            texture = corners[:, [a, b]] if axis != 1 else corners[:, [b, a]]
            faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
            parts.append(Mesh(corners, texture / tile_m, faces if sign > 0 else faces[:, ::-1]))
    return merged(parts)


def icosphere(radius: float, rings: int = 8, sides: int = 14, tiles: int = 2) -> Mesh:
    """A sphere of ``rings`` x ``sides`` cells, its texture wrapped around it ``tiles`` times."""
    theta = np.linspace(1e-3, np.pi - 1e-3, rings + 1)[:, None]
    phi = np.linspace(0, 2 * np.pi, sides + 1)[None]
    points = np.stack(np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)
    texture = np.stack(np.broadcast_arrays(phi / (2 * np.pi) * 2 * tiles, theta / np.pi * tiles), -1)
    faces = _grid_faces(rings + 1, sides + 1)[:, ::-1]
    return Mesh(radius * points.reshape(-1, 3), texture.reshape(-1, 2), faces.astype(np.int32))


def lumpy(mesh: Mesh, amount: float, random: np.random.Generator, waves: int = 5) -> Mesh:
    """A mesh about the origin, pushed in and out by smooth noise: a rock, a clump of moss, a crown of leaves."""
    direction = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    scale = np.ones(len(direction))
    for _ in range(waves):
        axis = random.normal(size=3) * 2.2
        scale += amount / np.sqrt(waves) * np.sin(direction @ axis + random.uniform(0, 2 * np.pi))
    return Mesh(mesh.vertices * scale[:, None], mesh.texcoords, mesh.faces)


def _rectangle_radius(angle: Floats, left: float, right: float, down: float, up: float) -> Floats:
    """Distance from the origin to the border of a rectangle around it, in each direction (y left, z up)."""
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        horizontal = np.where(c > 0, left / c, np.where(c < 0, -right / c, np.inf))
        vertical = np.where(s > 0, up / s, np.where(s < 0, -down / s, np.inf))
    return np.minimum(horizontal, vertical)


def _wall_rings(
    hole: Callable[[Floats], Floats], extent: tuple[float, float, float, float], count: int
) -> tuple[Floats, Floats]:
    """Hole contour and outer rectangle as points [N, 2] (y, z) in the same directions from the hole's centre."""
    left, right, down, up = extent
    corners = np.arctan2([up, up, -down, -down], [left, -right, -right, left])
    angle = np.sort(np.concatenate([np.linspace(-np.pi, np.pi, count, endpoint=False), corners]))
    ray = np.stack([np.cos(angle), np.sin(angle)], 1)
    return hole(angle)[:, None] * ray, _rectangle_radius(angle, left, right, down, up)[:, None] * ray


def perforated_wall(
    hole: Callable[[Floats], Floats],
    extent: tuple[float, float, float, float],
    thickness: float,
    count: int = 120,
    tile_m: float = 0.8,
) -> Mesh:
    """A wall across x with a hole around the origin.

    Args:
        hole: the contour's distance from the origin in a direction (radians from y, towards z).
        extent: distances from the origin to the wall's left (+y), right, lower and upper border.
    """
    inner, outer = _wall_rings(hole, extent, count)
    n = len(inner)
    i = np.arange(n)
    j = (i + 1) % n
    parts = []
    for x, flip in ((-thickness / 2, False), (thickness / 2, True)):
        flat = np.concatenate([inner, outer])
        vertices = np.concatenate([np.full((2 * n, 1), x), flat], axis=1)
        faces = np.concatenate([np.stack([i, j, n + j], 1), np.stack([i, n + j, n + i], 1)])
        parts.append(Mesh(vertices, flat / tile_m, (faces[:, ::-1] if flip else faces).astype(np.int32)))
    rim = np.concatenate([inner, inner[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rim, axis=0), axis=1))]) / tile_m
    vertices = np.concatenate(
        [np.concatenate([np.full((n + 1, 1), x), rim], axis=1) for x in (-thickness / 2, thickness / 2)]
    )
    texture = np.concatenate([np.stack([along, np.full_like(along, v)], 1) for v in (0.0, thickness / tile_m)])
    parts.append(Mesh(vertices, texture, _grid_faces(2, n + 1)[:, ::-1].astype(np.int32)))
    return merged(parts)


def sector_prisms(
    hole: Callable[[Floats], Floats], extent: tuple[float, float, float, float], thickness: float, count: int = 48
) -> list[Floats]:
    """The same wall as convex pieces for collisions: corner points [8, 3] of one prism per direction."""
    inner, outer = _wall_rings(hole, extent, count)
    prisms = []
    for i in range(len(inner)):
        j = (i + 1) % len(inner)
        quad = np.stack([inner[i], inner[j], outer[j], outer[i]])
        front, back = (np.concatenate([np.full((4, 1), x), quad], axis=1) for x in (-thickness / 2, thickness / 2))
        if np.linalg.norm(inner[i] - inner[j]) > 1e-9:
            prisms.append(np.concatenate([front, back]))
    return prisms
