"""Options that contradict each other or are out of range are refused before any work."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from meshsplats._common.geometry import direction
from meshsplats.blender import LightOptions, SceneOptions
from meshsplats.blender.options import LIGHTS, check_environment
from meshsplats.cameras.framing import front_axes
from meshsplats.scene.colors import linear_to_srgb


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (SceneOptions(engine="povray"), "engine must be one of cycles, eevee"),
        (SceneOptions(samples=0), "samples must be a whole number from 1 to 65536, got 0"),
        (SceneOptions(samples=17), "1 to 16"),
        (SceneOptions(light=LightOptions(), samples=70000), "samples must be a whole number from 1 to 65536"),
        (SceneOptions(background=(0, 0, 2)), "background must be RGB in"),
        (SceneOptions(threads=0), "threads"),
        (SceneOptions(denoise=True), "denoise is for lit"),
        (SceneOptions(light=LightOptions(), denoise=True, engine="eevee"), "denoise is for lit"),
        (SceneOptions(fast=True), "fast is for lit images"),
        (SceneOptions(light=LightOptions(sun=(0, 91))), "elevation of -90 to 90"),
        (SceneOptions(light=LightOptions(sun=(float("nan"), 1))), "azimuth"),
        (SceneOptions(light=LightOptions(sun_strength=-1)), "sun_strength must be a number from 0 to"),
        (SceneOptions(light=LightOptions(sky=float("nan"))), "sky must be a number"),
        (SceneOptions(light=LightOptions(sun_color=(1, 2, 0))), "sun_color must be linear RGB"),
        (SceneOptions(light=LightOptions(roughness=1.1)), "roughness must be a number from 0 to 1"),
        (SceneOptions(light=LightOptions(bounces=65)), "bounces"),
        (SceneOptions(light=LightOptions(ground="grass")), "ground must be one of plane, catcher, none"),
        (SceneOptions(light=LightOptions(ground="catcher"), engine="eevee"), "Cycles only"),
    ],
)
def test_impossible_options_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        options.check()


def test_defaults_are_good():
    SceneOptions().check()
    SceneOptions(light=LightOptions(), samples=64).check()
    assert {f.name for f in fields(LightOptions)} >= {"sun", "hdri", "ground", "mirror", "glass"}


def test_environment_images_are_known_by_content(tmp_path):
    good, bad = tmp_path / "sky.hdr", tmp_path / "sky.exr"
    good.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n")
    bad.write_bytes(b"\x89PNG\r\n")
    check_environment(good)
    with pytest.raises(ValueError, match=r"\.hdr or an OpenEXR file; this is neither"):
        check_environment(bad)
    with pytest.raises(FileNotFoundError):
        SceneOptions(light=replace(LightOptions(), hdri=tmp_path / "none.hdr")).check()


@pytest.mark.parametrize("name", LIGHTS)
def test_a_white_plate_stays_white(name):
    """Lying, and upright before a viewer who looks down on it by 15 degrees, in the middle of a ground that
    reflects 0.6 of the light, 250 of 255 and more: irradiance by Lambert's law."""
    light, up = LIGHTS[name], np.array([0.0, 0, 1])
    axes = front_axes(up)

    def radiance(normal, ground):
        suns = ((light.sun, light.sun_strength), (light.fill_direction, light.fill))
        direct = sum(strength * max(direction(axes, *at) @ normal, 0) for at, strength in suns) / np.pi
        return direct + light.sky * (1 + normal[2]) / 2 + 0.6 * ground * (1 - normal[2]) / 2

    lying = radiance(up, 0)
    facing = radiance(direction(axes, 0, 15), lying)
    shown = linear_to_srgb(np.clip(2**light.exposure * np.array([lying, facing]), 0, 1))
    assert (255 * shown >= 250).all()


def test_named_lights_and_what_is_said_instead():
    from meshsplats.cli.blender import BlenderOptions, LightArguments

    def light(lights, **given):
        return BlenderOptions(lit=True, lights=lights, light=LightArguments(**given)).named_light()

    for name, named in LIGHTS.items():
        named.check()
        assert light(name) == named
    # Also what is the default of another light counts, and 0.
    assert light("overcast", sun_strength=2.5) == replace(LIGHTS["overcast"], sun_strength=2.5)
    assert light("sun", sky=0.0, mirror=True) == replace(LIGHTS["sun"], sky=0.0, mirror=True)


def test_an_environment_image_lights_without_a_second_sun(tmp_path):
    from meshsplats.blender.files import PictureOptions
    from meshsplats.cli.blender import BlenderOptions, LightArguments

    sky = tmp_path / "sky.hdr"

    def sun(lights=None, **given):
        return BlenderOptions(lit=True, lights=lights, light=LightArguments(hdri=sky, **given)).named_light()

    alone = PictureOptions(lit=True, light=LightOptions(hdri=sky)).named_light()
    assert sun() == alone
    assert (alone.sun_strength, alone.fill) == (0, 0)
    assert sun("sun").sun_strength == sun(sun=(0, 30)).sun_strength == LIGHTS["sun"].sun_strength
    assert sun("noon").sun_strength == LIGHTS["noon"].sun_strength
    assert sun(sun_strength=1.5).sun_strength == 1.5


def test_a_catcher_has_no_background(tmp_path):
    from meshsplats.blender.files import PictureOptions
    from meshsplats.errors import OptionsError

    caught = PictureOptions(lit=True, light=LightOptions(ground="catcher"))
    caught.scene_options(tmp_path / "a.png")
    with pytest.raises(OptionsError, match="ground catcher, whose images have an alpha channel"):
        replace(caught, background="#336699").scene_options(tmp_path / "a.png")


@pytest.mark.parametrize("name", ["lit.png", "lit.blend", "views/cameras.json", "views/view_0000.png"])
def test_what_exists_is_refused_before_views_are_looked_for(tmp_path, monkeypatch, name):
    from meshsplats.blender import files

    there = tmp_path / name
    there.parent.mkdir(exist_ok=True)
    there.write_bytes(b"mine")
    output = there if there.parent == tmp_path else there.parent
    monkeypatch.setattr(files, "command", lambda executable: [])
    run = files.PictureRun(tmp_path / "not read.ply", output, files.PictureOptions(lit=True))
    with pytest.raises(FileExistsError, match=there.name):
        run.save()


@pytest.mark.parametrize(
    ("terms", "options", "seconds"),
    [
        (0, SceneOptions(light=LightOptions(), samples=10, threads=2), (1e6 * 10 * 20.3e-6 + 7) / 2),
        (8, SceneOptions(light=LightOptions(), samples=10, threads=1, denoise=True), 1e6 * 223e-6 + 7),
        (0, SceneOptions(light=LightOptions(), threads=1, denoise=True, fast=True), 1e6 * 205e-6 + 2.525),
        (0, SceneOptions(threads=1), 1e6 * 10 * 19.3e-6),
        (8, SceneOptions(threads=1), 1e6 * 10 * (19.3e-6 + 8 * 1.4e-6)),
        (0, SceneOptions(engine="eevee"), None),
    ],
)
def test_the_estimate(terms, options, seconds):
    from meshsplats.blender.plan import estimated_seconds

    ahead = {
        "harmonics": terms,
        "mean_layers": 10,
        "mean_square_layers": 1000,
        "samples": 10,
        "pixels": 10**6,
        "triangles": 0,
    }
    assert estimated_seconds(ahead, options) == (None if seconds is None else pytest.approx(seconds))


def test_time_left_follows_the_estimate_and_then_the_clock():
    from meshsplats.blender.launch import Progress
    from meshsplats.blender.plan import PHASES, Schedule, estimated_seconds, phase_seconds

    ahead = {"mean_layers": 10, "mean_square_layers": 100, "samples": 16, "pixels": 10**6, "triangles": 10**6}
    options = SceneOptions(light=LightOptions(), samples=16, threads=2)
    seconds, whole = phase_seconds(ahead, options), estimated_seconds(ahead, options)
    assert list(seconds) == list(PHASES)
    assert sum(phase_seconds(ahead, replace(options, fast=True)).values()) < sum(seconds.values()) / 2
    now = [0.0]
    schedule = Schedule(ahead, options, lambda: now[0])

    def left(stage, done=0, share=0.0, images=4):
        text = schedule.with_time(Progress(done, images, share, stage, None)).left
        return None if text is None else float(text.split()[0]) * (60 if "min" in text else 1)

    assert left("colours") == pytest.approx(whole, rel=0.1)
    now[0] = 5.0
    assert left("colours") == pytest.approx(whole - 5, rel=0.1)
    now[0] = 3 * seconds["colours"]  # six times as long as two threads should take
    rest = 2 * whole - seconds["colours"]
    assert left("surface") == pytest.approx(3 * rest, rel=0.1)
    assert left("colours") is None, "again, for a coarser level: not estimated"
    assert left("Sample 3/16") is None, "nothing is known of images yet"
    now[0] += 30
    assert left("Sample 8/16", 1, 0.5) == pytest.approx(30 / 1.5 * 2.5, abs=5)
    alone = Progress(0, 1, 0.5, "Sample 8/16", "00:12")
    assert schedule.with_time(alone) == alone, "Blender's own words"


def test_a_named_light_lights():
    from meshsplats.blender.files import PictureOptions

    assert not PictureOptions().is_lit
    assert PictureOptions(lights="noon").is_lit
    assert PictureOptions(lights="noon").named_light() == LIGHTS["noon"]
    assert PictureOptions(lit=True).named_light() == LIGHTS["sun"]
    assert PictureOptions(fast=True).is_lit


def test_phases_are_told_at_once(capsys):
    from meshsplats.blender.launch import Progress
    from meshsplats.blender.plan import Lines
    from meshsplats.cli.messages import say

    show = Lines(say)
    for stage in ("light", "light", "Sample 3/16", "Updating Geometry"):
        show(Progress(0, 1, 0.0, stage, "20 s"))
    assert capsys.readouterr().err.splitlines() == ["meshsplats: Blender: light, 20 s left"]
