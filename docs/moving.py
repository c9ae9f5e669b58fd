"""Animated pictures of environments: some seconds with the best policy, the character in view."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from dm_control.mujoco import engine
from scipy import ndimage

from trl_suite import rendering, suite
from trl_suite.environments import named_policies
from trl_suite.environments.environment import Environment
from trl_suite.rendering import overlays
from trl_suite.rendering.web_scene import root_body
from trl_suite.util.files import Path, check_path, replacing

SUFFIXES = ('.webp',)
SIZE = (300, 480)  # height and width, pixels
SAMPLES, SHADOWS = 4, 4096  # samples per pixel, and size of the shadow map, for smooth edges
FRAME = 1 / 30  # s; between two moments
STRIDE = 2  # moments per picture: 15 pictures per second
SECONDS = 4.0
SEEDS = range(1, 7)  # tried in order until an episode does not fail
# Seed and begin (s) of typical episodes, of environments whose first seconds are not typical. If such
# an episode fails, as it may with a new policy, other seeds are tried.
SCENES = {
    'PD_Biped3D_HLC_Soccer-v0': (8, 8.0),
    'PD_Biped3D_Terrain_Soccer_Hard-v0': (5, 3.0),
    'PD_Biped3D_HLC_Conveyors-v0': (2, 16.0),
    'PD_Biped3D_HLC_Conveyors_Wide-v0': (2, 11.0),
}
# Camera angles in order of preference: azimuth from the heading, and elevation, degrees.
PLANAR_VIEW = (74.0, -12.0)
SPATIAL_VIEWS = (
    (50.0, -20.0), (-50.0, -20.0), (130.0, -20.0), (-130.0, -20.0), (20.0, -25.0), (50.0, -42.0),
    (-50.0, -42.0), (0.0, -50.0), (90.0, -65.0),
)  # fmt: skip
VIEW_COST = 0.02  # added to the hidden fraction of the character for each place in this order
LOOKS = 8  # moments at which visibility of the character is tested
FILL = 0.5  # fraction of the picture's height or width that the character fills
SMOOTH = 15  # moments; standard deviation of the weights that smooth the camera's path
QUALITY = 70  # of the WebP file


class Shot(NamedTuple):
    """An episode to be rendered.

    Attributes:
      states: states of the environment, `FRAME` apart.
      root: positions of the character's root, (moments, 3) m.
      lasted: whether the episode did not fail.
    """

    states: list[dict[str, Any]]
    root: np.ndarray
    lasted: bool


def moving_picture(
    id: str, seconds: float = SECONDS, size: tuple[int, int] = SIZE
) -> list[np.ndarray]:
    """Renders an environment with its best policy; see `named_policies.best`.

    Args:
      id: id of the environment.
      seconds: duration; shorter if an episode fails earlier with every seed.
      size: height and width, pixels.

    Returns:
      Pictures `STRIDE` * `FRAME` apart, each (height, width, 3) uint8.
    """
    id = suite.find(id).id
    environment = suite.make(id)
    _, policy = named_policies.best(environment, id)
    first, begin = SCENES.get(id, (SEEDS[0], 0.0))
    best: Shot | None = None
    for seed in dict.fromkeys((first, *SEEDS)):
        shot = _take(environment, policy, seed, begin, seconds)
        if best is None or len(shot.states) > len(best.states):
            best = shot
        if shot.lasted:
            break
    assert best is not None
    return _draw(environment, best, size)


def side_by_side(
    rows: Sequence[Sequence[str]], seconds: float, size: tuple[int, int]
) -> list[np.ndarray]:
    """Renders several environments in rows; the duration is that of the shortest.

    Args:
      rows: rows of ids.
      seconds: as in `moving_picture`, which also has the errors.
      size: height and width of each picture, pixels.
    """
    grid = [[moving_picture(id, seconds, size) for id in row] for row in rows]
    count = min(len(images) for row in grid for images in row)
    return [
        np.concatenate([np.concatenate([images[k] for images in row], axis=1) for row in grid])
        for k in range(count)
    ]


def save(images: Sequence[np.ndarray], path: Path, source: str = '') -> None:
    """Writes pictures of `moving_picture` as an animated WebP that loops in real time.

    Args:
      images: (h, w, 3) uint8 each.
      path: file to write; .webp.
      source: digest to store in the file.
    """
    from PIL import Image

    path = check_path(path, SUFFIXES)
    if not images:
        raise ValueError('an animated picture needs at least one picture')
    first, *others = map(Image.fromarray, images)
    content = io.BytesIO()
    first.save(
        content, 'webp', save_all=True, append_images=others, loop=0, quality=QUALITY, method=4,
        duration=round(1000 * STRIDE * FRAME), xmp=source.encode(),
    )  # fmt: skip
    with replacing(path) as part:
        part.write_bytes(content.getvalue())


def _take(
    environment: Environment,
    policy: Callable[[Any], np.ndarray],
    seed: int,
    begin: float,
    seconds: float,
) -> Shot:
    """Runs an episode, and returns its states from the time `begin` (s)."""
    states: list[dict[str, Any]] = []
    root, body = [], root_body(environment)
    count, first, last = 0, round(begin / FRAME), round((begin + seconds) / FRAME)

    def look() -> None:
        nonlocal count
        if first <= count <= last:
            states.append(environment.get_state())
            root.append(environment.physics.data.xpos[body].copy())
        count += 1

    environment.random_state.seed(seed)
    time_step = environment.reset()
    look()
    while count <= last and not time_step.last():
        with rendering.calling_each_frame(environment, look):
            time_step = environment.step(policy(time_step))
    return Shot(states, np.array(root), not time_step.last() or time_step.discount > 0)


def _draw(environment: Environment, shot: Shot, size: tuple[int, int]) -> list[np.ndarray]:
    physics, task = environment.physics, environment.task
    environment.set_state(shot.states[0])
    figure = _extent(environment)
    height, width = size
    view = np.tan(0.5 * np.deg2rad(physics.model.vis.global_.fovy))
    distance = 0.5 / (view * FILL) * max(figure[2], max(figure[:2]) * height / width)
    middle = _smooth(shot.root)
    azimuth, elevation = _free_view(environment, shot, middle, distance)
    drawn = overlays.of_task(task)

    def add(physics: Any, scene: Any) -> None:
        for overlay in drawn:
            overlay(physics, scene)

    # These are read when the rendering context is created, for the first picture.
    quality = physics.model.vis.quality
    quality.offsamples, quality.shadowsize = SAMPLES, SHADOWS
    physics.model.vis.global_.offheight, physics.model.vis.global_.offwidth = size
    rendering.check_gl(physics)
    camera = engine.MovableCamera(physics, height, width, scene_callback=add)
    images = []
    for state, place in zip(shot.states[::STRIDE], middle[::STRIDE], strict=True):
        environment.set_state(state)
        camera.set_pose(place, distance, azimuth, elevation)
        images.append(camera.render().copy())
    return images


def _extent(environment: Environment) -> np.ndarray:
    """Returns the size of the box around the character, along x, y, z, (3,) m."""
    model, data = environment.physics.model, environment.physics.data
    own = model.body_rootid[model.geom_bodyid] == model.body_rootid[root_body(environment)]
    places, radii = data.geom_xpos[own], model.geom_rbound[own, None]
    return (places + radii).max(0) - (places - radii).min(0)


def _smooth(path: np.ndarray) -> np.ndarray:
    """Returns a path smoothed by Gaussian weights, (k, 3) m."""
    # Beyond its ends the path goes on with its mean velocity.
    line = np.linspace(path[0], path[-1], len(path))
    offset = path - line
    return line + ndimage.gaussian_filter1d(offset, SMOOTH, axis=0, mode='constant', truncate=3)


def _free_view(
    environment: Environment, shot: Shot, middle: np.ndarray, distance: float
) -> tuple[float, float]:
    """Returns azimuth and elevation, degrees, from which obstacles hide little of the character."""
    if not environment.task.arena.terrain.spatial:
        return PLANAR_VIEW
    travelled = shot.root[-1] - shot.root[0]
    heading = np.rad2deg(np.arctan2(travelled[1], travelled[0]))
    views = [(heading + azimuth, elevation) for azimuth, elevation in SPATIAL_VIEWS]
    cost = VIEW_COST * np.arange(len(views))
    moments = rendering.spread(len(shot.states), LOOKS)
    for k in moments:
        environment.set_state(shot.states[k])
        for i, (azimuth, elevation) in enumerate(views):
            a, e = np.deg2rad([azimuth, elevation])
            ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
            cost[i] += _hidden(environment, middle[k] - distance * ahead) / len(moments)
    return views[int(cost.argmin())]


def _hidden(environment: Environment, eye: np.ndarray) -> float:
    """Returns the fraction of the character's links that are hidden from a point."""
    model, data = environment.physics.model.ptr, environment.physics.data.ptr
    root = root_body(environment)
    own = np.flatnonzero(model.body_rootid == model.body_rootid[root])
    geom, hidden = np.zeros(1, np.int32), 0
    for link in own:
        ray = data.xpos[link] - eye
        mujoco.mj_ray(model, data, eye, ray, None, 1, -1, geom)
        hit = (
            geom[0] >= 0
            and model.body_rootid[model.geom_bodyid[geom[0]]] != model.body_rootid[root]
        )
        hidden += bool(hit)
    return hidden / len(own)
