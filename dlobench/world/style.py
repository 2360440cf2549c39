"""Reads how a picture looks: colours, textures, light and cameras, from a small TOML file.

`styles/paper.toml` names every field with its default; another file says only what differs from it.
"""

from __future__ import annotations

import math
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from dlobench.errors import UsageError

FOLDER = Path(__file__).with_name("styles")
DEFAULT = "paper"
BUILTIN = ("flat", "checker", "gradient")


def _check_colour(text: str) -> str:
    if not re.fullmatch("#[0-9a-fA-F]{6}", text):
        raise ValueError('a colour is red, green and blue in hexadecimal, such as "#d55e00"')
    return text


Colour = Annotated[str, AfterValidator(_check_colour)]
Share = Annotated[float, Field(ge=0, le=1)]
Place = tuple[float, float, float]  # x m, y m, z m
Pixels = Annotated[int, Field(ge=16, le=4096, multiple_of=2)]  # films come in even sizes


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Surface(_Part):
    """Describes what a part of the scene is made of."""

    colour: Colour
    second: Colour  # the other colour of a checker or a gradient
    texture: str  # flat, checker, gradient, or a PNG file: square but for the table's; relative to the style file
    repeat: Annotated[int, Field(ge=1, le=100)]  # how often the texture is laid side by side
    reflectance: Share  # of what stands on the table; of flat tops only
    specular: Share  # strength of highlights
    shininess: Share  # sharpness of highlights


class Light(_Part):
    """Describes the one lamp, whose parallel rays go from its place to the centre of the table."""

    position: Place
    ambient: Share  # light that comes from everywhere
    diffuse: Share  # light of the lamp
    specular: Share  # the lamp's part in highlights
    shadows: bool

    @model_validator(mode="after")
    def _shines_from_above(self) -> Light:
        if self.position[2] <= 0:
            raise ValueError(f"position is {self.position[2]} m high, the lamp hangs above the table")
        return self


class Camera(_Part):
    """Describes a camera; what is above in the picture is up or, seen from straight above, north (y)."""

    position: Place
    lookat: Place
    fovy: Annotated[float, Field(ge=1, le=120)]  # degrees from the lower to the upper border
    width: Pixels
    height: Pixels

    @model_validator(mode="after")
    def _stands_off(self) -> Camera:
        if math.dist(self.position, self.lookat) < 0.01:
            raise ValueError("position and lookat are less than 0.01 m apart")
        return self


class Cameras(_Part):
    """Holds the two cameras."""

    top: Camera
    oblique: Camera


class Style(_Part):
    """Describes how a picture looks."""

    background: Colour
    table: Surface
    walls: Surface
    dlo: Surface
    cylinder: Surface  # what an attached DLO ends in
    bodies: Surface
    pusher: Surface
    light: Light
    camera: Cameras


CameraName = Literal["top", "oblique"]
CAMERAS: tuple[CameraName, ...] = get_args(CameraName)


def find_camera(name: str) -> CameraName:
    """Returns a camera by name; raises `UsageError` naming the choices."""
    for camera in CAMERAS:
        if name == camera:
            return camera
    raise UsageError(f"unknown camera {name!r}; there are: {', '.join(CAMERAS)}")


def names() -> list[str]:
    """Returns the names of the styles that are shipped, the default first."""
    return sorted((path.stem for path in FOLDER.glob("*.toml")), key=lambda name: (name != DEFAULT, name))


def load(style: str = DEFAULT) -> Style:
    """Loads a style by its name or from its TOML file; raises `UsageError` naming field, value and choices."""
    if style in names():
        path = FOLDER / f"{style}.toml"
    else:
        path = Path(style)
        if path.suffix != ".toml" or not path.is_file():
            raise UsageError(f"style {style!r} is neither a .toml file nor one of {', '.join(names())}")
    try:
        found = Style.model_validate(_merged(_defaults(), _parsed(path)))
    except ValidationError as error:
        raise UsageError(f"style {path}: {_sentence(error)}") from error
    for name, field in found:
        if isinstance(field, Surface) and field.texture not in BUILTIN:
            texture = path.parent / field.texture
            if texture.suffix != ".png" or not texture.is_file():
                choices = f"{', '.join(BUILTIN)} nor a .png file"
                raise UsageError(f"style {path}: {name}.texture {field.texture!r} is neither {choices}")
            placed = field.model_copy(update={"texture": str(texture.absolute())})
            found = found.model_copy(update={name: placed})
    return found


@cache
def _defaults() -> dict[str, Any]:
    return _parsed(FOLDER / f"{DEFAULT}.toml")


def _parsed(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read style {path}: {error.strerror}") from error
    except ValueError as error:  # also what is not UTF-8
        raise UsageError(f"style {path} is not TOML: {error}") from error


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Lays one tree of tables over another."""
    out = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(below.get(key), dict)
        out[key] = _merged(below[key], value) if both else value
    return out


def _sentence(error: ValidationError) -> str:
    """Says what the first thing wrong in a style file is."""
    first = error.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"]))
    if first["type"] == "extra_forbidden":
        table: Any = _defaults()
        for key in first["loc"][:-1]:
            table = table[key]
        return f"there is no field {where}; there are: {', '.join(table)}"
    value = "" if isinstance(first["input"], dict | BaseModel) else f" = {first['input']!r}"
    return f"{where}{value}: {first['msg'].removeprefix('Value error, ')}"
