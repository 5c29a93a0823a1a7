# SPDX-License-Identifier: MIT
"""Generated scenes with everything known about them: spheres and boxes before a floor and a slanted wall, ray-cast.

Camera frame: x right, y down, z forward, metres; the floor lies about 1 m below the camera. Depth is the z coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

FLOOR, WALL = 0, 1
_WAVES = 6  # sinusoids in a texture


@dataclass
class SceneOptions:
    """What scenes hold."""

    spheres: int = 2
    boxes: int = 2
    texture: float = 0.3  # contrast of the surfaces' pattern, 0 to 1
    frequency: float = 12.0  # of the pattern, radians per metre
    plain_share: float = 0.0  # of the surfaces have no pattern
    light_spread: float = 0.4  # how much the light's direction varies
    floor_spread: float = 0.0  # how much the floor's height (metres) and slopes vary

    @property
    def surfaces(self) -> int:
        """Floor, wall, spheres, boxes, in the order of their indices."""
        return 2 + self.spheres + self.boxes


@dataclass
class Scenes:
    """N random scenes; all tensors start with [N, S] for the S surfaces of SceneOptions."""

    options: SceneOptions
    floor: Tensor  # [N, 4]: unit normal and offset, normal . X = offset
    wall: Tensor  # [N, 4], likewise
    centre: Tensor  # [N, S, 3] of spheres and boxes
    size: Tensor  # [N, S, 3]: half extents; a sphere's first entry is its radius
    turn: Tensor  # [N, S, 3, 3]: rotation from camera to a box's own axes
    colour: Tensor  # [N, S, 3] RGB, 0 to 1
    contrast: Tensor  # [N, S]
    waves: Tensor  # [N, S, _WAVES, 4]: wave vector in radians per metre and phase
    light: Tensor  # [N, 3]: unit vector towards the light


@dataclass
class View:
    """What a camera sees of N scenes."""

    image: Tensor  # float32 [N, 3, H, W], 0 to 1
    depth: Tensor  # float32 [N, 1, H, W], metres
    normal: Tensor  # float32 [N, 3, H, W], unit, towards the camera
    surface: Tensor  # int64 [N, 1, H, W]: index of the surface
    point: Tensor  # float32 [N, 3, H, W]: what is seen, in the frame of the scene


def _uniform(generator: torch.Generator, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator)


def random_scenes(count: int, generator: torch.Generator, options: SceneOptions | None = None) -> Scenes:
    """`count` scenes drawn from `generator`; equal generators give equal scenes."""
    options = options or SceneOptions()
    n, s = count, options.surfaces

    def between(low: float, high: float, *shape: int) -> Tensor:
        return _uniform(generator, *shape, low=low, high=high)

    yaw = between(-0.6, 0.6, n)
    wall_normal = torch.stack([yaw.sin(), torch.zeros(n), -yaw.cos()], 1)
    ahead = between(5.0, 8.0, n, 1)  # metres to the wall, along the camera's axis
    wall = torch.cat([wall_normal, wall_normal[:, 2:] * ahead], 1)
    tilt = options.floor_spread * between(-0.5, 0.5, n, 2)
    floor_normal = functional.normalize(torch.stack([tilt[:, 0], -torch.ones(n), tilt[:, 1]], 1), dim=1)
    below = 1.0 + options.floor_spread * between(-1.0, 1.0, n, 1)
    floor = torch.cat([floor_normal, floor_normal[:, 1:2] * below], 1)
    size = between(0.25, 0.75, n, s, 3)
    distance = between(2.2, 5.5, n, s)
    # Spread over the image: sideways positions grow with distance. Some rest on the floor, some float.
    sideways, height = between(-0.45, 0.45, n, s) * distance, between(-0.9, 0.6, n, s)
    centre = torch.stack([sideways, height, distance], 2)
    angles = between(-0.9, 0.9, n, s, 3) * torch.tensor([0.4, 1.0, 0.3])
    direction = torch.randn(n, s, _WAVES, 3, generator=generator)
    direction = functional.normalize(direction, dim=-1) * between(0.3, 1.0, n, s, _WAVES, 1) * options.frequency
    light = torch.tensor([-0.5, -0.8, -0.6]) + options.light_spread * between(-1.0, 1.0, n, 3)
    plain = torch.rand(n, s, generator=generator) < options.plain_share
    return Scenes(
        options=options,
        floor=floor,
        wall=wall,
        centre=centre,
        size=size,
        turn=_rotations(angles),
        colour=between(0.25, 0.95, n, s, 3),
        contrast=torch.where(plain, 0.0, options.texture),
        waves=torch.cat([direction, between(0.0, 6.2832, n, s, _WAVES, 1)], -1),
        light=functional.normalize(light, dim=1),
    )


def _rotations(angles: Tensor) -> Tensor:
    """Rotation about x, then y, then z: [..., 3] radians -> [..., 3, 3]."""
    zero, one = torch.zeros_like(angles[..., 0]), torch.ones_like(angles[..., 0])
    (cx, cy, cz), (sx, sy, sz) = angles.cos().unbind(-1), angles.sin().unbind(-1)

    def matrix(*entries: Tensor) -> Tensor:
        return torch.stack(entries, -1).unflatten(-1, (3, 3))

    about_x = matrix(one, zero, zero, zero, cx, -sx, zero, sx, cx)
    about_y = matrix(cy, zero, sy, zero, one, zero, -sy, zero, cy)
    about_z = matrix(cz, -sz, zero, sz, cz, zero, zero, zero, one)
    return about_z @ about_y @ about_x


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _cast(scenes: Scenes, origin: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Rays [R, 3] from origin [3] -> distance [N, S, R] (inf where missed) and normal [N, S, R, 3] of every surface."""
    options = scenes.options
    n, r = scenes.wall.shape[0], rays.shape[0]
    spheres = slice(2, 2 + options.spheres)
    boxes = slice(2 + options.spheres, None)
    miss = torch.full((), torch.inf)

    def plane(normal: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
        """normal [N, 3], offset [N] -> [N, 1, R], [N, 1, R, 3]."""
        along = normal @ rays.T
        t = (offset - normal @ origin)[:, None] / torch.where(along.abs() < 1e-6, 1e-6, along)
        t = torch.where(t > 1e-3, t, miss)
        return t[:, None], normal[:, None, None].expand(n, 1, r, 3)

    found = [
        plane(scenes.floor[:, :3], scenes.floor[:, 3]),
        plane(scenes.wall[:, :3], scenes.wall[:, 3]),
    ]

    # |origin + t ray - centre| = radius
    offset = origin - scenes.centre[:, spheres]
    a, b = _dot(rays, rays), offset @ rays.T
    c = _dot(offset, offset) - scenes.size[:, spheres, 0].square()
    root = b.square() - a * c[..., None]
    t = (-b - root.clamp_min(0.0).sqrt()) / a
    t = torch.where((root > 0) & (t > 1e-3), t, miss)
    hit = offset[:, :, None] + torch.where(t.isfinite(), t, 0.0)[..., None] * rays
    found.append((t, functional.normalize(hit, dim=-1)))

    # Slabs: a box is entered where the last of its three pairs of planes is.
    turn, half = scenes.turn[:, boxes], scenes.size[:, boxes, None]
    start = (turn @ (origin - scenes.centre[:, boxes])[..., None]).transpose(-1, -2)
    ahead = torch.einsum("nsij,rj->nsri", turn, rays)
    ahead = torch.where(ahead.abs() < 1e-6, 1e-6, ahead)
    near, far = (-ahead.sign() * half - start) / ahead, (ahead.sign() * half - start) / ahead
    t, axis = near.max(-1)
    t = torch.where((t < far.min(-1).values) & (t > 1e-3), t, miss)
    face = functional.one_hot(axis, 3) * -ahead.sign()
    found.append((t, torch.einsum("nsij,nsri->nsrj", turn, face)))
    return torch.cat([t for t, _ in found], 1), torch.cat([normal for _, normal in found], 1)


def _rays(height: int, width: int, focal_px: float) -> Tensor:
    """Directions (x, y, 1) through the pixels' centres, [H * W, 3], with y downwards."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    x, y = (x - (width - 1) / 2) / focal_px, (y - (height - 1) / 2) / focal_px
    return torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3)


def render(scenes: Scenes, height: int, width: int, focal_px: float, shift_m: float = 0.0) -> View:
    """What a camera moved to the right by `shift_m` sees: colour with shading, depth, normals and surfaces."""
    n, pixels = scenes.wall.shape[0], height * width
    origin, rays = torch.tensor([shift_m, 0.0, 0.0]), _rays(height, width, focal_px)
    distances, normals = _cast(scenes, origin, rays)
    depth, surface = distances.min(1)  # rays have z = 1: the distance is the depth
    normal = normals.gather(1, surface[:, None, :, None].expand(n, 1, pixels, 3))[:, 0]
    point = origin + depth[..., None] * rays

    def of_surface(values: Tensor) -> Tensor:
        """[N, S, ...] -> [N, pixels, ...] of the surface seen."""
        index = surface.reshape(n, pixels, *[1] * (values.dim() - 2)).expand(n, pixels, *values.shape[2:])
        return values.gather(1, index)

    wave = of_surface(scenes.waves)
    phase = _dot(wave[..., :3], point[:, :, None]) + wave[..., 3]
    pattern = (phase.sin().sum(-1) * (2.0 / _WAVES)).clamp(-1.0, 1.0)
    brightness = 1.0 + of_surface(scenes.contrast) * pattern
    shading = 0.3 + 0.7 * _dot(normal, scenes.light[:, None]).clamp_min(0.0)
    image = (of_surface(scenes.colour) * (brightness * shading)[..., None]).clamp(0.0, 1.0)

    def picture(values: Tensor) -> Tensor:
        """[N, pixels, C] -> [N, C, H, W]."""
        return values.transpose(1, 2).reshape(n, -1, height, width).contiguous()

    return View(picture(image), picture(depth[..., None]), picture(normal), picture(surface[..., None]), picture(point))


# --- where things end ----------------------------------------------------------------------------------------------


def spread(mask: Tensor, radius: int = 1) -> Tensor:
    """A boolean mask [N, 1, H, W], grown by `radius` pixels in every direction."""
    return functional.max_pool2d(mask.float(), 2 * radius + 1, 1, radius) > 0.5


def object_boundary(surface: Tensor) -> Tensor:
    """Pixels beside another surface; int64 [N, 1, H, W] -> bool."""
    values = surface.float()
    return functional.max_pool2d(values, 3, 1, 1) > -functional.max_pool2d(-values, 3, 1, 1)


def depth_boundary(depth: Tensor, ratio: float = 1.3) -> Tensor:
    """Pixels in whose 3x3 neighbourhood the depth jumps by more than `ratio`; [N, 1, H, W] -> bool."""
    inverse = depth.reciprocal()  # linear in the image on a plane
    return functional.max_pool2d(inverse, 3, 1, 1) > ratio * -functional.max_pool2d(-inverse, 3, 1, 1)


def crease(normal: Tensor, degrees: float = 30.0) -> Tensor:
    """Pixels beside another normal, turned by more than `degrees`; unit [N, 3, H, W] -> bool [N, 1, H, W]."""
    limit = torch.cos(torch.deg2rad(torch.tensor(degrees)))
    found = torch.zeros_like(normal[:, :1], dtype=torch.bool)
    for axis in (2, 3):
        size = normal.shape[axis] - 1
        turned = (normal.narrow(axis, 0, size) * normal.narrow(axis, 1, size)).sum(1, keepdim=True) < limit
        found.narrow(axis, 0, size).logical_or_(turned)
        found.narrow(axis, 1, size).logical_or_(turned)
    return found
