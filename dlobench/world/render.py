"""Draws recorded poses: a scene of its own, made to be looked at, in which nothing is simulated.

Every part is put where it was recorded; one capsule a segment, round at both ends, makes the DLO one smooth cable.
Heights that a planar world does not record are those of the simulated scene, but for the pusher and the walls, which
are drawn low so that they hide little.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from dlobench.domain import (
    BOX_SIZE,
    DLO_RADIUS,
    MAX_BODIES,
    MAX_SEGMENTS,
    PUSHER_RADIUS,
    SEGMENT_LENGTH,
    WORKSPACE,
    Domain,
)
from dlobench.errors import UsageError
from dlobench.world import canvas
from dlobench.world import style as styles
from dlobench.world.chain import CYLINDER_HEIGHT, CYLINDER_RADIUS
from dlobench.world.pictures import Frame
from dlobench.world.style import BUILTIN, Camera, CameraName, Style, Surface

PUSHER_HEIGHT = 0.03  # m
WALL_HEIGHT = 0.012  # m
WALL_WIDTH = 0.006  # m
NEAR, FAR = 0.01, 20.0  # m, what is seen of the world
TEXELS = 512  # edge of a built-in texture
_SIDES = {"table": mujoco.mjtTexture.mjTEXTURE_2D}  # the others are cubes


def frames(
    domain: Domain,
    *,
    dlo: NDArray[np.floating],
    pusher: NDArray[np.floating],
    bodies: NDArray[np.floating],
    cylinder: NDArray[np.floating] | None = None,
    style: Style | None = None,
    camera: CameraName = "top",
    depth: bool = False,
) -> Iterator[Frame]:
    """Draws T recorded states of a domain, one frame each: an `Image`, or with `depth` a `Depth` (see `pictures`).

    dlo (T, 32, 3), bodies (T, 3, 3), cylinder (T, 3) x m, y m, yaw rad; pusher (T, 2) x m, y m; padding is not looked
    at. Without a cylinder none is drawn, nor in a domain whose DLO has none. The style's camera says how many pixels.
    Raises `UsageError` for arrays of another shape, numbers that are not finite or an unknown camera, `RunError` when
    there is no OpenGL to draw with.
    """
    look = styles.load() if style is None else style
    styles.find_camera(camera)
    T = len(dlo)
    shapes = {"dlo": (T, MAX_SEGMENTS, 3), "pusher": (T, 2), "bodies": (T, MAX_BODIES, 3), "cylinder": (T, 3)}
    given = {"dlo": dlo, "pusher": pusher, "bodies": bodies, "cylinder": cylinder}
    for name, array in given.items():
        if array is not None and (array.shape != shapes[name] or not np.isfinite(array).all()):
            raise UsageError(f"{name} {array.shape} is not an array {shapes[name]} of finite numbers")
    if domain.attachment == "none":
        cylinder = None
    upright = np.concatenate([pusher, np.zeros((T, 1))], axis=1)
    parts = [dlo[:, : domain.segments], bodies[:, : len(domain.bodies)], upright[:, None]]
    poses = np.concatenate(parts if cylinder is None else [*parts, cylinder[:, None]], axis=1)
    return _draw(build(domain, look, cylinder=cylinder is not None), poses, look, camera, depth=depth)


def _draw(
    model: mujoco.MjModel, poses: NDArray[np.floating], style: Style, camera: CameraName, *, depth: bool
) -> Iterator[Frame]:
    """Yields one picture for each of T rows of poses (T, moved bodies, 3) x m, y m, yaw rad."""
    view: Camera = getattr(style.camera, camera)
    data = mujoco.MjData(model)
    with canvas.renderer(model, view.width, view.height) as renderer:
        if depth:
            renderer.enable_depth_rendering()
        for moved in np.asarray(poses, dtype=float):
            data.mocap_pos[:, :2] = moved[:, :2]
            data.mocap_quat[:, 0], data.mocap_quat[:, 3] = np.cos(moved[:, 2] / 2), np.sin(moved[:, 2] / 2)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, camera)
            picture = renderer.render()
            yield np.where(picture < 0.99 * FAR, picture, np.float32(np.inf)) if depth else picture


def build(domain: Domain, style: Style, *, cylinder: bool) -> mujoco.MjModel:
    """Compiles the scene. Its moved bodies stand in the order segments, rigid bodies, pusher and, if any, cylinder.

    Raises `UsageError` when a texture cannot be read.
    """
    out = mujoco.MjSpec()
    out.stat.extent = 1.0  # so that what MuJoCo measures in extents is in metres
    out.visual.map.znear, out.visual.map.zfar = NEAR, FAR
    out.visual.map.shadowclip = 2 * WORKSPACE  # closer, and what is lit would be speckled with shadows of its own
    out.visual.quality.shadowsize = 4096  # texels over twice that: a quarter of a millimetre each
    out.visual.global_.offwidth = max(style.camera.top.width, style.camera.oblique.width)
    out.visual.global_.offheight = max(style.camera.top.height, style.camera.oblique.height)
    for name, surface in style:
        if isinstance(surface, Surface):
            _add_material(out, name, surface)
    _add_backdrop(out, style)
    _add_surroundings(out)
    capsule, box, upright = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    along = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # a capsule's axis is laid along x
    for _ in range(domain.segments):
        segment = out.worldbody.add_body(mocap=True, pos=[0, 0, DLO_RADIUS])
        segment.add_geom(type=capsule, size=[DLO_RADIUS, SEGMENT_LENGTH / 2, 0], quat=along, material="dlo")
    for rigid in domain.bodies:
        body = out.worldbody.add_body(mocap=True, pos=[0, 0, BOX_SIZE / 2])
        for x, y, yaw, half_x, half_y in rigid.boxes():
            turn = [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
            body.add_geom(type=box, pos=[x, y, 0], quat=turn, size=[half_x, half_y, BOX_SIZE / 2], material="bodies")
    solids = [("pusher", PUSHER_RADIUS, PUSHER_HEIGHT), ("cylinder", CYLINDER_RADIUS, CYLINDER_HEIGHT)]
    for name, radius, height in solids if cylinder else solids[:1]:
        body = out.worldbody.add_body(mocap=True, pos=[0, 0, height / 2])
        body.add_geom(type=upright, size=[radius, height / 2, 0], material=name)
    try:
        return out.compile()
    except ValueError as error:  # only a texture comes from outside
        raise UsageError(f"a texture of the style cannot be read: {error}") from error


def _colour(text: str) -> list[float]:
    """Returns "#rrggbb" as shares of red, green and blue."""
    return [int(text[i : i + 2], 16) / 255 for i in (1, 3, 5)]


def _add_material(out: mujoco.MjSpec, name: str, surface: Surface) -> None:
    material = out.add_material(
        name=name, reflectance=surface.reflectance, specular=surface.specular, shininess=surface.shininess
    )
    if surface.texture == "flat":
        material.rgba = [*_colour(surface.colour), 1]
        return
    texture = out.add_texture(name=name, type=_SIDES.get(name, mujoco.mjtTexture.mjTEXTURE_CUBE))
    if surface.texture in BUILTIN:
        builtin = mujoco.mjtBuiltin
        texture.builtin = builtin.mjBUILTIN_CHECKER if surface.texture == "checker" else builtin.mjBUILTIN_GRADIENT
        texture.width = texture.height = TEXELS
        texture.rgb1, texture.rgb2 = _colour(surface.colour), _colour(surface.second)
    else:
        texture.file = surface.texture
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    material.texrepeat = [surface.repeat] * 2


def _add_backdrop(out: mujoco.MjSpec, style: Style) -> None:
    """Adds background, lamp and cameras."""
    sky = out.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT)
    sky.width = sky.height = 8
    sky.rgb1 = sky.rgb2 = _colour(style.background)
    shown = style.light
    out.visual.headlight.ambient = [shown.ambient] * 3
    out.visual.headlight.diffuse = out.visual.headlight.specular = [0, 0, 0]
    out.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=shown.position,
        dir=[-x for x in shown.position],
        ambient=[0, 0, 0],
        diffuse=[shown.diffuse] * 3,
        specular=[shown.specular] * 3,
        castshadow=shown.shadows,
    )
    for name, view in style.camera:
        out.worldbody.add_camera(name=name, pos=view.position, quat=_facing(view), fovy=view.fovy)


def _facing(view: Camera) -> NDArray[np.float64]:
    """Returns the quaternion of a camera that looks where it should: x to the right, y up, from the scene along z."""
    back = np.subtract(view.position, view.lookat)
    back /= np.linalg.norm(back)
    up = np.array([0.0, 1.0, 0.0]) if abs(back[2]) > 1 - 1e-9 else np.array([0.0, 0.0, 1.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(back, right), back], axis=1).ravel())
    return quat


def _add_surroundings(out: mujoco.MjSpec) -> None:
    """Adds the table and, just outside of the workspace, the walls."""
    half, thick = WORKSPACE / 2, WALL_WIDTH / 2
    rim = half + WALL_WIDTH
    out.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[rim, rim, 0.01], material="table")
    for axis, side in product((0, 1), (-1, 1)):
        pos, size = [0.0, 0.0, WALL_HEIGHT / 2], [thick, thick, WALL_HEIGHT / 2]
        pos[axis] = side * (half + thick)
        size[1 - axis] = rim if axis else half  # one pair reaches over the corners
        out.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=pos, size=size, material="walls")
