# SPDX-License-Identifier: MIT
"""One trial from take-off to its end, and what is measured on the way."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ajna.sim.camera import Frame
from ajna.sim.flight import Flight
from ajna.sim.methods import make_method
from ajna.sim.methods.skills import SkillMethod
from ajna.sim.observation import Method, Observation, Output, TaskSetup
from ajna.sim.render import Renderer
from ajna.sim.vehicle import Command
from ajna.sim.worlds import DodgeSetup, GapSetup, PileSetup, World

__all__ = ["DETECTION_IOU", "EpisodeResult", "intersection_over_union", "run_episode", "true_mask"]

DETECTION_IOU = 0.5
Watcher = Callable[[Observation, Output], None]


@dataclass
class EpisodeResult:
    """What a trial gave. Lengths in metres, times in seconds unless named otherwise; None: does not apply.

    success: reached the goal, or was not hit, without touching anything (pile: IoU of the mask >= 0.5).
    reason: goal, missed (the object), seen (the pile), collision, outside, or time.
    safe_point_error_same_px: likewise from the one that the same skill gives on maps of true motion: what its signal
        costs; None for methods that are no skills.
    detection_iou: of the mask with the true one on the frame on which the method acted; 0: it never did.
    safe_point_error_px: mean distance of the method's point from the one that true depth gives on the same frame.
    decided_s: time of the frame on which the method first acted on a detection; None: it never did.
    best_iou: the largest on any frame from then on.
    run_time_ms: median per frame of the method's processor time, all threads together, pictures not counted.
    cpu_s: processor time of the trial, physics, pictures, method and judge together (without making the world).
    path: (t, x, y, z) once a frame.
    """

    world: str
    method: str
    seed: int
    success: bool
    reason: str
    touched: str | None
    variant: str | None
    duration_s: float
    frames: int
    path_length_m: float
    mean_speed_m_s: float
    reference_path_length_m: float | None = None
    safe_point_error_px: float | None = None
    detection_iou: float | None = None
    run_time_ms: float | None = None
    decided_s: float | None = None
    best_iou: float | None = None
    cpu_s: float | None = None
    safe_point_error_same_px: float | None = None
    path: list[tuple[float, ...]] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def intersection_over_union(mask: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    """IoU of two masks; 0 where both are empty."""
    union = int((mask | truth).sum())
    return float((mask & truth).sum()) / union if union else 0.0


def true_mask(world: World, frame: Frame) -> NDArray[np.bool_] | None:
    """What the mask of a method should be on a frame, bool [H, W]; None for navigating."""
    setup = world.setup
    if isinstance(setup, DodgeSetup):
        number = mujoco.mj_name2id(world.model, mujoco.mjtObj.mjOBJ_BODY, setup.body)
        return frame.body == number
    if isinstance(setup, PileSetup):
        return (frame.geom >= 0) & (world.model.geom_type[frame.geom] != mujoco.mjtGeom.mjGEOM_PLANE)
    if isinstance(setup, GapSetup):
        # What is seen through the plane of the wall, inside the contour: the ray meets the plane before anything.
        import cv2

        pose = frame.T_world_camera
        points = (setup.contour - pose[:3, 3]) @ pose[:3, :3]
        points[:, 2] = np.maximum(points[:, 2], 0.05)
        pixels, _ = frame.camera.project(points)
        inside = np.zeros((frame.camera.height, frame.camera.width), np.uint8)
        shift = 4
        fixed = np.rint(np.clip(pixels, -4000, 4000) * 2**shift).astype(np.int32)
        cv2.fillPoly(inside, [fixed], 1, shift=shift)
        reach = frame.depth * (frame.camera.rays @ pose[0, :3]) + pose[0, 3]
        return inside.astype(bool) & ~(reach < setup.wall_x + 0.03)
    return None


def _prepare(frame: Frame, method: Method) -> None:
    """Render what the method needs, so that its run time is its own."""
    if "rgb" in method.needs:
        _ = frame.rgb
    if "right" in method.needs:
        frame.right(method.baseline_m)  # type: ignore[attr-defined]  # what needs a second camera says where it sits
    if "depth" in method.needs:
        _ = frame.body


def _setup_for(world: World) -> TaskSetup:
    return TaskSetup(world.task, world.camera, world.speed_m_s, world.vehicle.half_width_m, world.seed)


def _outcome(world: World, flight: Flight) -> str | None:
    """How the trial ended, or None while it goes on."""
    if flight.collision is not None:
        return "collision"
    x, y, _ = flight.position
    x_min, x_max, y_min, y_max = world.bounds
    if not (x_min <= x <= x_max and y_min <= y <= y_max):
        return "outside"
    if world.task in ("navigate", "gap") and x >= world.goal[0]:
        return "goal"
    if flight.time_s >= world.time_limit_s:
        return "missed" if world.task == "dodge" else "time"
    return None


def run_episode(
    world: World,
    method: Method | str,
    renderer: Renderer | None = None,
    watch: Watcher | None = None,
    reference: bool | EpisodeResult | None = None,
) -> EpisodeResult:
    """Fly one trial.

    Args:
        world: made anew or used before: a trial does not change it.
        method: a method, or the name of one that needs no weights.
        renderer: of the world's model, where one is at hand; otherwise one is made and closed.
        watch: called with every observation and the answer to it, for videos.
        reference: whether true depth flies the same world, too, to compare the paths (navigation only), or its trial
            in this world where it has flown already; by default it flies for every method but true depth.

    Raises:
        ValueError: the method does not do the world's task; NoRenderingError: nothing can be rendered here.
    """
    flown = make_method(method) if isinstance(method, str) else method
    own = Renderer(world.model, world.camera) if renderer is None else renderer
    try:
        if world.task == "pile":
            return _look(world, flown, own, watch)
        result = _fly(world, flown, own, watch)
        if reference is None:
            reference = world.task == "navigate" and flown.name != "depth"
        if reference and world.task == "navigate":
            truth = reference if isinstance(reference, EpisodeResult) else _fly(world, make_method("depth"), own, None)
            result.reference_path_length_m = truth.path_length_m if truth.success else None
        return result
    finally:
        if renderer is None:
            own.close()


def _mean(values: list[float] | None) -> float | None:
    return float(np.mean(values)) if values else None


def _judges(world: World, method: Method) -> dict[str, Method]:
    """What says beside a method that navigates where the safe point is: true depth, and a skill's own planner on it."""
    judges: dict[str, Method] = {}
    if world.task == "navigate" and method.name != "depth":
        judges["depth"] = make_method("depth")
        if isinstance(method, SkillMethod):
            judges["same"] = method.on_true_motion()
    for judge in judges.values():
        judge.reset(_setup_for(world))
    return judges


def _fly(world: World, method: Method, renderer: Renderer, watch: Watcher | None) -> EpisodeResult:
    begin = time.process_time()
    flight = Flight(world, renderer, world.seed)
    method.reset(_setup_for(world))
    judges = _judges(world, method)
    command, reason = Command(), None
    errors: dict[str, list[float]] = {name: [] for name in judges}
    run_times: list[float] = []
    iou: float | None = None if world.task == "navigate" or not getattr(method, "shows_masks", True) else 0.0
    decided_s: float | None = None
    best_iou = iou
    while reason is None:
        frame = flight.advance(command)
        observation = flight.observe(frame)
        _prepare(frame, method)
        start = time.process_time()
        output = method(observation)
        elapsed = time.process_time() - start
        if output.planned:
            run_times.append(elapsed)
        command = output.command
        for name, judge in judges.items():
            ideal = judge(observation).point_px
            if ideal is not None and output.point_px is not None:
                errors[name].append(float(np.hypot(*np.subtract(ideal, output.point_px))))
        if output.decided and decided_s is None:
            decided_s = frame.time_s
        if best_iou is not None and decided_s is not None and output.mask is not None:
            truth = true_mask(world, frame)
            if truth is not None:
                here = intersection_over_union(output.mask, truth)
                iou, best_iou = (here if output.decided else iou), max(best_iou, here)
        if watch is not None:
            watch(observation, output)
        reason = _outcome(world, flight)
    path = np.array(flight.path)
    length = float(np.linalg.norm(np.diff(path[:, 1:], axis=0), axis=1).sum())
    return EpisodeResult(
        world=world.name,
        method=method.name,
        seed=world.seed,
        success=reason in ("goal", "missed"),
        reason=reason,
        touched=flight.collision,
        variant=_variant(world),
        duration_s=flight.time_s,
        frames=len(flight.path) - 1,
        path_length_m=length,
        mean_speed_m_s=length / flight.time_s,
        safe_point_error_px=_mean(errors.get("depth")),
        safe_point_error_same_px=_mean(errors.get("same")),
        detection_iou=iou,
        run_time_ms=1e3 * float(np.median(run_times)) if run_times else None,
        decided_s=decided_s,
        best_iou=best_iou,
        cpu_s=time.process_time() - begin,
        path=[tuple(round(v, 4) for v in point) for point in flight.path],
    )


def _look(world: World, method: Method, renderer: Renderer, watch: Watcher | None) -> EpisodeResult:
    """The two views of a pile; the mask counts on the second one."""
    assert isinstance(world.setup, PileSetup)
    begin = time.process_time()
    flight = Flight(world, renderer, world.seed)
    method.reset(_setup_for(world))
    run_time, iou = 0.0, 0.0
    for index, view in enumerate(world.setup.views):
        frame = flight.at_rest(view, index)
        observation = flight.observe(frame)
        _prepare(frame, method)
        start = time.process_time()
        output = method(observation)
        run_time = time.process_time() - start
        truth = true_mask(world, frame)
        iou = 0.0 if output.mask is None or truth is None else intersection_over_union(output.mask, truth)
        if watch is not None:
            watch(observation, output)
    success = iou >= DETECTION_IOU
    return EpisodeResult(
        world=world.name,
        method=method.name,
        seed=world.seed,
        success=success,
        reason="seen" if success else "time",
        touched=None,
        variant=world.setup.kind,
        duration_s=0.0,
        frames=2,
        path_length_m=0.0,
        mean_speed_m_s=0.0,
        detection_iou=iou,
        run_time_ms=1e3 * run_time,
        cpu_s=time.process_time() - begin,
    )


def _variant(world: World) -> str | None:
    if isinstance(world.setup, GapSetup):
        return world.setup.shape
    return world.setup.kind if isinstance(world.setup, DodgeSetup) else None
