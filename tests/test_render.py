"""Tests pictures: what was recorded is seen where it was, styles change the looks alone, files are whole."""

from __future__ import annotations

import ctypes
import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from test_cli import Done, check_failed, entry
from test_store import files, write

from dlobench.cli import main
from dlobench.data.domain_set import PUSHES, Unit
from dlobench.data.sets import SETS
from dlobench.data.store import Store
from dlobench.domain import BOX_SIZE, DLO_RADIUS, MAX_BODIES, MAX_SEGMENTS, SEGMENT_LENGTH, Attachment, Domain, sample
from dlobench.errors import UsageError
from dlobench.trajectories import Trajectories
from dlobench.world import pictures, render, style
from dlobench.world.chain import CYLINDER_HEIGHT

META = SETS["meta-learning"]
INDEX = max(span.domain for span in META.spans("mini"))
PIXEL = 0.27 / 480  # m, about what a pixel of the camera above covers of the table
Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def drawing() -> None:
    """Skips what needs OpenGL where its library is not to be had; where it is, what cannot draw fails."""
    if sys.platform == "linux":
        try:
            ctypes.CDLL("libEGL.so.1")
        except OSError as error:
            pytest.skip(f"nothing can be drawn here: {error}; on Debian `apt-get install libegl1 libgl1`")


needs_opengl = pytest.mark.usefixtures("drawing")


def domain(*, attachment: Attachment = "none", length: float = 0.16, bodies: int = 2) -> Domain:
    """Samples a domain of a cell."""
    rng = np.random.default_rng(5)
    return sample(rng, material="flexible", attachment=attachment, length=length, rigid_objects=bodies)


def states(count: int = 1) -> dict[str, Any]:
    """Makes states in which nothing hides anything: the DLO is an arc that turns and moves from state to state."""
    s = np.arange(MAX_SEGMENTS) * SEGMENT_LENGTH
    dlo = np.zeros((count, MAX_SEGMENTS, 3))
    for t in range(count):
        yaw = 0.3 + 0.2 * t + 9.0 * s
        steps = SEGMENT_LENGTH * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
        dlo[t, :, :2] = np.array([0.01 * t, -0.05]) + np.cumsum(steps, axis=0)
        dlo[t, :, 2] = yaw
    pusher = np.array([-0.07, 0.05]) + 0.01 * np.arange(count)[:, None]
    bodies = np.zeros((count, MAX_BODIES, 3))
    bodies[:, 0], bodies[:, 1] = [-0.08, -0.08, 0.7], [0.08, -0.08, -2.0]
    return {"dlo": dlo, "pusher": pusher, "bodies": bodies}


def draw(world: Domain, still: dict[str, Any], **options: Any) -> list[NDArray[Any]]:
    """Draws states."""
    return list(render.frames(world, **still, **options))


def small(look: style.Style | None = None) -> style.Style:
    """Returns a style, by default the default, with small pictures, which are drawn fast."""
    look = look or style.load()
    cameras = {name: view.model_copy(update={"width": 160, "height": 120}) for name, view in look.camera}
    return look.model_copy(update={"camera": look.camera.model_copy(update=cameras)})


def pixel(place: Any, z: float) -> tuple[int, int]:
    """Returns row and column where the default camera above sees (x, y) at height z, by a pinhole's geometry."""
    x, y = place
    view = style.load().camera.top
    focal = view.height / 2 / np.tan(np.radians(view.fovy) / 2) / (view.position[2] - z)
    return int(view.height / 2 - focal * y), int(view.width / 2 + focal * x)


def looks_like(pixels: NDArray[Any], part: str) -> NDArray[np.bool_]:
    """Tells which pixels have the hue of a part in the default style, in light or in shade."""
    surface = getattr(style.load(), part)
    colour = np.array([int(surface.colour[i : i + 2], 16) for i in (1, 3, 5)], float)
    given = pixels.astype(float)
    cosine = given @ colour / np.maximum(np.linalg.norm(given, axis=-1), 1) / np.linalg.norm(colour)
    out: NDArray[np.bool_] = cosine > 0.99
    return out


def test_the_hues_of_the_default_style_can_be_told_apart_here() -> None:
    """The DLO's hue is that of no other part, so that a test can find it."""
    shown = style.load()
    for part in ("table", "walls", "bodies", "cylinder", "pusher"):
        colour = getattr(shown, part).colour
        assert not looks_like(np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]), "dlo")


@needs_opengl
@pytest.mark.parametrize("length", [0.10, 0.16])
def test_the_dlo_is_seen_where_it_was_recorded_and_nowhere_else(length: float) -> None:
    world, still = domain(length=length), states(3)
    for t, image in enumerate(draw(world, still)):
        assert image.shape == (480, 480, 3)
        assert image.dtype == np.uint8
        poses = still["dlo"][t, : world.segments]
        centres = poses[:, :2]
        between = (centres[1:] + centres[:-1]) / 2
        for x, y in [*centres, *between]:
            assert looks_like(image[pixel((x, y), 2 * DLO_RADIUS)], "dlo"), "one smooth cable"
        rows, columns = np.nonzero(looks_like(image, "dlo"))
        line = np.concatenate([centres, between])
        spots = np.array([pixel((x, y), DLO_RADIUS) for x, y in line])
        apart = np.linalg.norm(np.stack([rows, columns], axis=-1)[:, None] - spots, axis=-1).min(axis=1)
        assert apart.max() < (SEGMENT_LENGTH / 2 + DLO_RADIUS) / PIXEL + 2, "nothing else looks like the DLO"
        for (x, y, yaw), way in ((poses[0], -1), (poses[-1], 1)):  # its ends are round, and lie along the recorded yaw
            reach = way * (SEGMENT_LENGTH / 2 + 0.6 * DLO_RADIUS)
            along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
            assert looks_like(image[pixel((x, y) + reach * along, DLO_RADIUS)], "dlo")
            assert not looks_like(image[pixel((x, y) + reach * across, DLO_RADIUS)], "dlo")


@needs_opengl
@pytest.mark.parametrize("attachment", ["none", "fixed", "movable"])
def test_pusher_bodies_and_cylinder_are_seen_where_they_were_recorded(attachment: Attachment) -> None:
    world, still = domain(attachment=attachment), states()
    cylinder = np.array([[-0.01, 0.09, 0.4]])
    (image,) = draw(world, still, cylinder=cylinder)
    assert looks_like(image[pixel(cylinder[0, :2], CYLINDER_HEIGHT)], "cylinder") == (attachment != "none")
    assert looks_like(image[pixel(still["pusher"][0], render.PUSHER_HEIGHT)], "pusher")
    assert looks_like(image[pixel((0.1, 0.1), 0)], "table")
    for (x, y, yaw), rigid in zip(still["bodies"][0], world.bodies, strict=False):
        for box in rigid.boxes():
            place = (x + np.cos(yaw) * box[0] - np.sin(yaw) * box[1], y + np.sin(yaw) * box[0] + np.cos(yaw) * box[1])
            assert looks_like(image[pixel(place, BOX_SIZE)], "bodies")
    (without,) = draw(world, still)
    assert not looks_like(without[pixel(cylinder[0, :2], CYLINDER_HEIGHT)], "cylinder")


@needs_opengl
@pytest.mark.parametrize("name", style.names())
def test_depth_is_the_distance_along_the_axis_whatever_the_style(name: str) -> None:
    world, still = domain(), states()
    look = style.load(name)
    (depth,) = draw(world, still, depth=True, style=look)
    assert depth.dtype == np.float32
    height = look.camera.top.position[2]
    for x, y, _ in still["dlo"][0, : world.segments]:
        assert depth[pixel((x, y), 2 * DLO_RADIUS)] == pytest.approx(height - 2 * DLO_RADIUS, abs=2e-4)
    assert depth[pixel(still["pusher"][0], render.PUSHER_HEIGHT)] == pytest.approx(
        height - render.PUSHER_HEIGHT, abs=2e-4
    )
    assert depth[pixel((0.1, 0.1), 0)] == pytest.approx(height, abs=2e-4)
    (depth,) = draw(world, still, depth=True, style=look, camera="oblique")
    view = look.camera.oblique
    assert depth[view.height // 2, view.width // 2] == pytest.approx(
        np.linalg.norm(np.subtract(view.position, view.lookat)), abs=1e-3
    ), "the table, where the camera looks"
    assert np.isinf(depth[0, 0]), "nothing is there"


@needs_opengl
@pytest.mark.parametrize("depth", [False, True])
def test_a_frame_depends_on_its_own_state_alone(depth: bool) -> None:
    world, still = domain(), states(3)
    together = draw(world, still, depth=depth, style=small())
    assert len({frame.tobytes() for frame in together}) == 3
    for t in (2, 0, 1):
        (alone,) = draw(world, {name: rows[[t]] for name, rows in still.items()}, depth=depth, style=small())
        assert alone.tobytes() == together[t].tobytes(), "same poses, same bytes"
    backwards = draw(world, {name: rows[::-1] for name, rows in still.items()}, depth=depth, style=small())
    assert [f.tobytes() for f in backwards] == [f.tobytes() for f in together[::-1]]


@needs_opengl
def test_every_recorded_pose_is_drawn_and_no_padding() -> None:
    world, still = domain(length=0.10), states()
    (image,) = draw(world, still, style=small())
    for name, at in (("dlo", 0), ("dlo", 19), ("pusher", None), ("bodies", 0), ("bodies", 1)):
        for column in range(still[name].shape[-1]):
            moved = still | {name: still[name].copy()}
            moved[name][(0, column) if at is None else (0, at, column)] += 0.02 if column < 2 else 0.5
            assert draw(world, moved, style=small())[0].tobytes() != image.tobytes(), (name, at, column)
    padded = still | {"dlo": still["dlo"].copy(), "bodies": still["bodies"].copy()}
    padded["dlo"][:, world.segments :], padded["bodies"][:, len(world.bodies) :] = 0.05, 0.05
    assert draw(world, padded, style=small())[0].tobytes() == image.tobytes()


@pytest.mark.parametrize("name", ["dlo", "pusher", "bodies", "cylinder"])
@pytest.mark.parametrize("spoil", [lambda rows: rows[:, :-1], lambda rows: rows * np.nan], ids=["short", "NaN"])
def test_poses_that_are_none_are_refused(name: str, spoil: Callable[[Floats], Floats]) -> None:
    still = states(2) | {"cylinder": np.zeros((2, 3))}
    still[name] = spoil(still[name])
    with pytest.raises(UsageError, match=f"{name} .*finite numbers"):
        render.frames(domain(), **still)


CHANGES = {
    "colour of the DLO": "[dlo]\ncolour = '#0072b2'",
    "colour of the bodies": "[bodies]\ncolour = '#0072b2'",
    "background": "background = '#808080'",
    "checker": "[table]\ntexture = 'checker'",
    "other colour of the checker": "[table]\ntexture = 'checker'\nsecond = '#808080'",
    "finer checker": "[table]\ntexture = 'checker'\nrepeat = 9",
    "gradient": "[walls]\ntexture = 'gradient'",
    "picture": "[table]\ntexture = 'noise.png'",
    "picture on bodies": "[bodies]\ntexture = 'noise.png'",
    "reflectance": "[table]\nreflectance = 0.5",
    "shininess": "[dlo]\nshininess = 1",
    "specular": "[dlo]\nspecular = 1.0",
    "place of the lamp": "[light]\nposition = [0.3, -0.3, 0.6]",
    "ambient": "[light]\nambient = 0.9",
    "diffuse": "[light]\ndiffuse = 0.1",
    "shadows": "[light]\nshadows = false",
    "field of view": "[camera.oblique]\nfovy = 30",
    "place of the camera": "[camera.oblique]\nposition = [0.1, -0.4, 0.4]",
    "what it looks at": "[camera.oblique]\nlookat = [0.05, 0, 0]",
}


@needs_opengl
def test_every_field_of_a_style_changes_the_picture(tmp_path: Path) -> None:
    world, still, seen = domain(), states(), {}
    noise = np.random.default_rng(0).integers(0, 255, (16, 16, 3)).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")
    for change, text in CHANGES.items():
        (tmp_path / "mine.toml").write_text(text)
        (image,) = draw(world, still, style=small(style.load(str(tmp_path / "mine.toml"))), camera="oblique")
        seen[image.tobytes()] = change
    (plain,) = draw(world, still, style=small(), camera="oblique")
    assert plain.tobytes() not in seen
    assert list(seen.values()) == list(CHANGES), "no two are alike"


@needs_opengl
def test_shipped_styles_look_different_and_sizes_are_the_styles(tmp_path: Path) -> None:
    assert style.names() == ["paper", "dark", "wood"]
    looks = {name: draw(domain(), states(), style=style.load(name))[0].tobytes() for name in style.names()}
    assert len(set(looks.values())) == 3
    assert looks["paper"] == draw(domain(), states())[0].tobytes(), "paper is the default"
    (tmp_path / "mine.toml").write_text("[camera.top]\nwidth = 64\nheight = 48")
    mine = style.load(str(tmp_path / "mine.toml"))
    assert draw(domain(), states(), style=mine)[0].shape == (48, 64, 3)
    assert mine.camera.oblique == style.load().camera.oblique, "what a file leaves out is the default's"


BAD_STYLES = {
    "moon = 1": ("moon", "background", "table", "dlo", "camera"),
    "[dlo]\ncolor = '#000000'": ("dlo.color", "colour", "texture", "reflectance"),
    "[camera.side]\nfovy = 3": ("camera.side", "top", "oblique"),
    "[camera.top]\nzoom = 3": ("camera.top.zoom", "position", "fovy"),
    "[dlo]\ncolour = 'red'": ("dlo.colour", "'red'"),
    "[dlo]\nreflectance = 2": ("dlo.reflectance", "2", "1"),
    "[dlo]\nreflectance = nan": ("dlo.reflectance", "nan"),
    "[dlo]\ntexture = 'moon'": ("dlo.texture", "'moon'", "flat", "checker", "gradient", ".png"),
    "[dlo]\ntexture = 'absent.png'": ("dlo.texture", "'absent.png'"),
    "[dlo]\nrepeat = 0": ("dlo.repeat", "0", "1"),
    "dlo = 'red'": ("dlo", "'red'"),
    "[light]\nposition = [0, 0]": ("light.position",),
    "[light]\nposition = [0, 0, -1]": ("light", "-1"),
    "[camera.top]\nlookat = [0, 0, 0.8]": ("camera.top", "position", "lookat"),
    "[camera.top]\nfovy = 180": ("camera.top.fovy", "180", "120"),
    "[camera.top]\nwidth = 481": ("camera.top.width", "481", "2"),
    "[camera.top]\nwidth = 1000000": ("camera.top.width", "1000000", "4096"),
    "dlo = ": ("TOML",),
}


@pytest.mark.parametrize("text", BAD_STYLES)
def test_a_wrong_style_is_told_in_one_sentence(text: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(UsageError) as error:
        style.load(str(path))
    assert all(part in str(error.value) for part in (str(path), *BAD_STYLES[text]))
    assert "\n" not in str(error.value)


def test_a_style_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match="TOML"):
        style.load(str(tmp_path / "mine.toml"))
    with pytest.raises(UsageError, match=r"moon.*paper, dark, wood"):
        style.load("moon")


def test_a_texture_that_is_no_picture_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.png").write_bytes(b"not a picture")
    (tmp_path / "mine.toml").write_text("[table]\ntexture = 'bad.png'")
    with pytest.raises(UsageError, match=r"bad\.png"):
        render.frames(domain(), **states(), style=style.load(str(tmp_path / "mine.toml")))


@pytest.fixture
def films() -> NDArray[np.uint8]:
    """Makes 21 frames, two of which are the same: a square that moves over a gradient."""
    frames = np.zeros((21, 64, 96, 3), np.uint8)
    frames[..., 1] = np.linspace(0, 255, 96)
    for t, frame in enumerate(frames):
        at = 3 * (t - (t > 10))
        frame[20:40, at : at + 20] = [213, 94, 0]
    return frames


def test_films_hold_every_state_for_the_same_time(films: NDArray[np.uint8]) -> None:
    seconds = float(pictures.HOLD)
    with av.open(io.BytesIO(pictures.encode(list(films), ".mp4")), "r") as film:
        shown = [frame.to_ndarray(format="rgb24").astype(int) for frame in film.decode(video=0)]
        assert film.streams.video[0].average_rate == 1 / pictures.HOLD
    assert len(shown) == 21
    assert max(np.abs(there - here).mean() for there, here in zip(shown, films, strict=True)) < 8
    gif = Image.open(io.BytesIO(pictures.encode(list(films), ".gif")))
    times, seen = [], []
    for t in range(gif.n_frames):  # type: ignore[attr-defined]  # a GIF has frames
        gif.seek(t)
        times += [gif.info["duration"]]
        seen += [np.asarray(gif.convert("RGB")).astype(int)] * round(times[-1] / seconds / 1000)
    assert sum(times) == pytest.approx(21 * seconds * 1000)
    assert max(np.abs(there - here).mean() for there, here in zip(seen, films, strict=True)) < 8


@pytest.mark.parametrize("suffix", pictures.SUFFIXES)
def test_the_same_frames_give_the_same_bytes(suffix: str, films: NDArray[np.uint8]) -> None:
    frames = list(films[:1] if suffix == ".png" else films)
    assert len({pictures.encode(frames, suffix) for _ in range(50)}) == 1


def test_depth_is_kept_in_tenths_of_a_millimetre_and_shown_on_one_scale() -> None:
    near = np.array([[0.5, 0.75], [np.inf, 9.0]], np.float32)
    assert np.asarray(Image.open(io.BytesIO(pictures.encode([near], ".png")))).tolist() == [[5000, 7500], [65535] * 2]
    far = np.full((32, 32), 1.0, np.float32)
    far[:8], far[24:] = 0.5, np.inf
    with av.open(io.BytesIO(pictures.encode([far, far.clip(max=0.75)], ".mp4")), "r") as film:
        one, other = (frame.to_ndarray(format="gray") for frame in film.decode(video=0))
    assert one[4, 4] > 230
    assert one[16, 16] < 25
    assert one[28, 28] < 25
    assert 100 < other[16, 16] < 150, "half as far, half as grey"


def test_an_unknown_kind_of_picture_is_refused() -> None:
    with pytest.raises(UsageError, match=r"\.jpg.*\.png, \.gif, \.mp4"):
        pictures.encode([np.zeros((16, 16, 3), np.uint8)], ".jpg")


Call = Callable[..., Done]


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Trajectories:
    """Writes a shard of a fake recording, and makes its folder the data folder."""
    monkeypatch.setenv("DLOBENCH_DATA", str(tmp_path / "data"))
    monkeypatch.delenv("DLOBENCH_DEBUG", raising=False)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return write(Store(tmp_path / "data"), META, Unit(META.name, INDEX, 0, META.block))


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Call:
    """Returns what calls `dlobench render` in this process."""

    def run(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["dlobench", "render", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            main()
        out, err = capsys.readouterr()
        assert isinstance(exit_.value.code, int)
        return Done(exit_.value.code, out, err)

    return run


RENDER = ("--domain", f"meta-learning/{INDEX}", "--trajectory", "3")


@needs_opengl
def test_a_picture_shows_the_state_that_is_asked_for(recorded: Trajectories, call: Call, tmp_path: Path) -> None:
    assert recorded.cylinder is not None
    still = {name: getattr(recorded, name)[3] for name in ("dlo", "pusher", "bodies", "cylinder")}
    drawn = draw(META.domain(INDEX), still)
    for push, options in ((PUSHES, ()), (0, ("--push", "0")), (7, ("--push", "7"))):
        done = call(*RENDER, *options, "--out", tmp_path / "new" / "x.PNG")
        assert done.code == 0, done.err
        image = np.asarray(Image.open(tmp_path / "new" / "x.PNG"))
        assert image.tobytes() == drawn[push].tobytes()
    (depth,) = draw(META.domain(INDEX), {k: v[-1:] for k, v in still.items()}, depth=True, camera="oblique")
    assert call(*RENDER, "--depth", "--camera", "oblique", "--out", tmp_path / "x.png").code == 0
    grey = np.asarray(Image.open(tmp_path / "x.png"))
    assert grey.dtype == np.uint16
    there = np.isfinite(depth)
    assert np.abs(grey[there] * pictures.DEPTH_UNIT - depth[there]).max() <= 0.51 * pictures.DEPTH_UNIT


@needs_opengl
@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_shows_every_state(suffix: str, recorded: Trajectories, call: Call, tmp_path: Path) -> None:
    tiny = tmp_path / "tiny.toml"
    tiny.write_text("[camera.top]\nwidth = 96\nheight = 96")
    out = tmp_path / f"x{suffix}"
    assert call(*RENDER, "--style", tiny, "--out", out).code == 0
    if suffix == ".mp4":
        with av.open(str(out)) as film:
            assert len(list(film.decode(video=0))) == PUSHES + 1
    else:
        with Image.open(out) as gif:
            assert gif.n_frames == PUSHES + 1  # type: ignore[attr-defined]  # a GIF has frames
    first = out.read_bytes()
    assert call(*RENDER, "--style", tiny, "--out", out).code == 0
    assert out.read_bytes() == first, "same recording, same bytes"


OUT = ("--out", "x.png")
BAD_USAGE: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
    ((*RENDER, "--out", "x.jpg"), ("x.jpg", ".png", ".gif", ".mp4")),
    ((*RENDER, "--out", "."), ("'.'", ".png")),
    ((*RENDER, *OUT, "--push", "21"), ("21", "0–20")),
    ((*RENDER, *OUT, "--push", "-1"), ("-1", "0–20")),
    ((*RENDER, "--out", "x.gif", "--push", "3"), ("--push", ".png")),
    ((*RENDER, *OUT, "--camera", "side"), ("'side'", "top", "oblique")),
    ((*RENDER, *OUT, "--style", "moon"), ("'moon'", "paper", "dark", "wood")),
    ((*RENDER, *OUT, "--style", "moon.toml"), ("'moon.toml'", "paper")),
    (("--domain", "meta-learning", "--trajectory", "3", *OUT), ("'meta-learning'", "SET/INDEX")),
    (("--domain", "moon/3", "--trajectory", "3", *OUT), ("'moon'", "meta-learning")),
    (("--domain", "meta-learning/x", "--trajectory", "3", *OUT), ("'x'", "0–6299")),
    (("--domain", "meta-learning/6300", "--trajectory", "3", *OUT), ("6300", "0–6299")),
    (("--domain", "meta-learning/-1", "--trajectory", "3", *OUT), ("-1", "0–6299")),
    (("--domain", "meta-learning/3", "--trajectory", "500", *OUT), ("500", "0–499")),
    (("--domain", "meta-learning/3", "--trajectory", "-1", *OUT), ("-1", "0–499")),
    (("--domain", "meta-learning/3", *OUT), ("--trajectory",)),
]


def test_help_names_every_style_camera_and_kind(call: Call) -> None:
    done = call("--help")
    assert done.code == 0
    assert not [word for word in (*style.names(), *style.CAMERAS, *pictures.SUFFIXES) if word not in done.out]


@pytest.mark.parametrize(("arguments", "parts"), BAD_USAGE, ids=" ".join)
def test_bad_usage_is_told_in_one_line(
    arguments: tuple[str, ...], parts: tuple[str, ...], recorded: Trajectories, call: Call, tmp_path: Path
) -> None:
    before = files(tmp_path)
    check_failed(call(*arguments), 2, *parts)
    assert files(tmp_path) == before


@pytest.mark.parametrize(
    ("index", "trajectory", "scale"), [(INDEX, 0, "mini"), (INDEX, 20, "small"), (INDEX, 60, "paper"), (1, 0, "paper")]
)
def test_a_trajectory_that_is_not_on_disk_is_named_with_what_makes_it(
    index: int, trajectory: int, scale: Any, call: Call, tmp_path: Path
) -> None:
    data = tmp_path / "no data"
    asked = ("--domain", f"meta-learning/{index}", "--trajectory", trajectory, "--data", data)
    done = call(*asked, "--out", tmp_path / "x.png")
    spans = META.spans(scale)
    count = [span.domain for span in spans].index(index) + 1
    command = f"`dlobench generate meta-learning --scale {scale} --domains {count} --data '{data}'`"
    check_failed(done, 1, str(data), command)
    assert trajectory < spans[count - 1].count, "that command makes the trajectory"
    assert not (tmp_path / "x.png").exists()


def break_texture(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "mine.png").write_bytes(b"not a picture")


def break_shard(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = next((folder / "data").rglob("*.npy"))
    path.write_bytes(path.read_bytes()[:-8])


def hide_package(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)


def fill_disk(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)


FAILURES: dict[str, tuple[Callable[[Path, pytest.MonkeyPatch], None], int, tuple[str, ...]]] = {
    "texture": (break_texture, 2, ("mine.png",)),
    "shard": (break_shard, 1, ("is broken", "repair")),
    "package": (hide_package, 1, ("av", "pip install 'dlobench[render]'")),
    "disk": (fill_disk, 1, ("cannot write", "No space left")),
}


@needs_opengl
@pytest.mark.parametrize("what", FAILURES)
def test_a_failure_leaves_the_picture_that_was_there(
    what: str, recorded: Trajectories, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil, code, parts = FAILURES[what]
    Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(tmp_path / "mine.png")
    (tmp_path / "mine.toml").write_text("[table]\ntexture = 'mine.png'\n[camera.top]\nwidth = 32\nheight = 32")
    asked = (*RENDER, "--style", tmp_path / "mine.toml", "--out", tmp_path / "x.mp4")
    assert call(*asked).code == 0
    (tmp_path / "x.mp4").write_bytes(b"mine")
    spoil(tmp_path, monkeypatch)
    before = files(tmp_path)
    check_failed(call(*asked), code, *parts)
    assert files(tmp_path) == before


@needs_opengl
def test_a_place_that_cannot_be_written_is_named(recorded: Trajectories, call: Call, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    check_failed(call(*RENDER, "--out", tmp_path / "file" / "x.png"), 1, "cannot write", str(tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "mine"


LINUX = pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa are Linux's")


@LINUX
@pytest.mark.parametrize(
    ("variable", "library", "package"),
    [("", "libEGL.so.1", "libegl1"), ("egl", "libEGL.so.1", "libegl1"), ("osmesa", "libOSMesa.so.8", "libosmesa6")],
)
def test_a_missing_library_is_named_with_the_package_that_brings_it(
    variable: str, library: str, package: str, recorded: Trajectories, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fakes = tmp_path / "fakes"
    fakes.mkdir()
    stem = library.split(".", maxsplit=1)[0]
    for end in ("so", *(f"so.{n}" for n in range(10))):
        (fakes / f"{stem}.{end}").write_bytes(b"")  # found before the real one, and not loadable
    monkeypatch.setenv("LD_LIBRARY_PATH", str(fakes))
    monkeypatch.setenv("MUJOCO_GL", variable)
    (tmp_path / "x.png").write_bytes(b"mine")
    done = entry("render", *RENDER, "--out", tmp_path / "x.png")
    check_failed(done, 1, library, f"apt-get install {package}")
    assert len(done.err.strip().splitlines()) == 1
    assert (tmp_path / "x.png").read_bytes() == b"mine"


@LINUX
@pytest.mark.parametrize("variable", ["moon", "off"])
def test_a_way_to_draw_that_there_is_not_is_refused(
    variable: str, recorded: Trajectories, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", variable)
    done = entry("render", *RENDER, "--out", tmp_path / "x.png")
    check_failed(done, 1, f"MUJOCO_GL={variable}", "egl", "osmesa")
    assert len(done.err.strip().splitlines()) == 1


@needs_opengl
def test_the_real_command_draws(recorded: Trajectories, tmp_path: Path) -> None:
    done = entry("render", *RENDER, "--out", tmp_path / "x.png")
    assert done.code == 0, done.err
    with Image.open(tmp_path / "x.png") as image:
        assert image.size == (480, 480)
    assert done.err == ""
