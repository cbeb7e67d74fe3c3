"""What a ``scene.toml`` may say, and what is said of one that cannot be rendered."""

import contextlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from support.commands import hyperpaint
from support.files import write_file
from support.refusals import expect_error, expect_words
from support.traced_scenes import SUN, flat_light, flight, two_cars

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintError, PaintWarning, SchemaError
from hyperpaint.io.collect.collect_toml import read_collect
from hyperpaint.io.spectrometers.spectrum_csv import read_spectrum_csv
from hyperpaint.paints import starter_library
from hyperpaint.simulation.atmosphere import Atmosphere
from hyperpaint.simulation.camera import BandSet
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.materials import Coat
from hyperpaint.simulation.rendering.relighting import by_name, factor_spectra
from hyperpaint.simulation.rendering.scene import SceneRecord, TraceSettings
from hyperpaint.workflows.rendering import (
    SceneFile,
    build_parts,
    chosen_atmospheres,
    example_scene,
    export_dirsig_scene,
    named_libraries,
    read_paints,
    read_scene_file,
    read_spectra,
    spectra_digest,
)

SMALL = """\
[scene]
kind = "plane"
spectrum = "asphalt"
[platform]
lines = 4
columns = 3
"""

CUBE = """\
v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
o body\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\no top\nf 5 6 7 8
"""

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    # Return what makes a scene file of a text
    def make(text: str) -> Path:
        return write_file(tmp_path / "scene.toml", text, encoding="utf-8")

    return make


def refused(path: Path) -> str:
    return str(expect_error(FormatError, None, lambda: build_parts(read_scene_file(path))))


def test_the_example_says_what_it_says(write: Write) -> None:
    file = read_scene_file(write(example_scene()))
    assert isinstance(file, SceneFile)
    assert file.name == "scene"
    assert file.scene == {"kind": "car_park", "seed": 3, "length_m": 22.0, "width_m": 16.0}
    assert file.platform == {
        "lines": 200, "columns": 160, "altitude": 15.0, "ground_sample": 0.1, "wobble": 0.1,
        "exposure_time": 0.005, "frame_period": 0.007,
    }  # fmt: skip
    assert [each.name for each in file.atmospheres] == ["noon", "near_sunset", "cloudy"]
    assert (file.sampling["samples"], file.sampling["depth"], file.product) == (64, 4, "counts")
    assert file.camera["first_wavelength"] == 399.356


def test_what_the_example_has_commented_out_is_known_too(write: Write, tmp_path: Path) -> None:
    whole = re.sub(r"(?m)^# (?=\[|[a-z_0-9]+ = )", "", example_scene())
    assert whole.count("\n[[meshes]]") == 1
    (tmp_path / "spectra").mkdir()
    (tmp_path / "spectra" / "mine.csv").write_text("300,0.2\n1200,0.3\n")
    (tmp_path / "truck.obj").write_text(CUBE)
    file = read_scene_file(write(whole))
    assert (file.scene["neighbours"], file.platform["centre"], file.platform["start_time"]) == (
        ["trees", "walls", "lamps"],
        (0.0, 11.0),
        "2021-07-20T17:10:00",
    )
    assert file.atmospheres[-1].options == {"sun_zenith": 60.0, "sun_azimuth": 100.0, "oktas": 3.0}
    assert file.paints == {"car_003": "mine", "red": "dark_red"}
    parts = build_parts(file)
    expect_words({each.name for each in parts.scene.instances}, "mesh_1", without=("truck",))
    assert parts.suns == [(25.0, 180.0), (82.0, 265.0), (60.0, 100.0)]
    assert parts.overcast


def test_a_flight_is_over_the_middle_of_what_is_there(write: Write) -> None:
    park = build_parts(read_scene_file(write(example_scene().replace("wobble_deg = 0.1", "wobble_deg = 0"))))
    np.testing.assert_allclose(park.platform.position.mean(axis=0), [0.0, 11.0, 15.0], atol=1e-9)
    assert park.camera.imager.wavelength_shift.size == park.platform.columns == 160


def test_meshes_are_placed_and_painted(write: Write, tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE)
    text = (
        SMALL
        + """
[[meshes]]
path = "cube.obj"
name = "crate"
kind = "car"
spectrum = "red"
coat_roughness = 0.2
materials = { top = { spectrum = "glass", class = "glass", coat_index = 1.6 } }
offset_m = [10.0, 0.0, 0.0]
heading_deg = 90.0
unit_m = 2.0
"""
    )
    scene = build_parts(read_scene_file(write(text))).scene
    crate = next(number for number, each in enumerate(scene.instances) if each.name == "crate")
    assert (scene.instances[crate].kind, scene.instances[crate].paint) == ("car", "red")
    corners = scene.vertices[scene.faces[scene.face_instance == crate].ravel()]
    np.testing.assert_allclose(
        [corners.min(axis=0), corners.max(axis=0)], [[10, -2, 0], [12, 0, 2]], atol=1e-9
    )
    made = {each.name: each for each in scene.materials}
    paint, top = made["paint of crate"], made["top of crate"]
    assert (
        (paint.kind, paint.coat.roughness if paint.coat else None),
        (top.kind, top.coat.index if top.coat else None),
    ) == (("paint", 0.2), ("glass", 1.6))


def test_patterns_begin_outside_the_folder_as_paths_may(write: Write, tmp_path: Path) -> None:
    (tmp_path / "asd").mkdir()
    for name in ("a.asd", "b.asd"):
        (tmp_path / "asd" / name).touch()
    light = "[[atmospheres]]\nname = 'a'\nirradiance = '../asd/*.asd'\ntime = 2021-09-27T16:55:55\n"
    light += "sun_zenith_deg = 40\nsun_azimuth_deg = 180\ndirect_fraction = 0.8\n"
    path = write(SMALL + light)
    inner = tmp_path / "inner" / "scene.toml"
    inner.parent.mkdir()
    path.rename(inner)
    assert [file.name for file in read_scene_file(inner).atmospheres[-1].irradiance] == ["a.asd", "b.asd"]


def test_light_may_come_from_a_table_or_be_changed(write: Write, tmp_path: Path) -> None:
    rows = "\n".join(f"{nm},1.0,0.2" for nm in range(340, 1101, 5))
    (tmp_path / "light.csv").write_text(f"wavelength [nm],sun [W m-2 nm-1],sky [W m-2 nm-1]\n{rows}\n")
    text = (
        SMALL
        + """
[[atmospheres]]
name = "flat"
table = "light.csv"
sun_zenith_deg = 60.0
[[atmospheres]]
name = "dull"
preset = "noon"
oktas = 8
[[atmospheres]]
preset = "cloudy"
sun_zenith_deg = 50.0
"""
    )
    parts = build_parts(read_scene_file(write(text)))
    flat, dull, cloudy = parts.atmospheres
    np.testing.assert_allclose(flat.irradiance, 0.7)
    assert dull.name == "dull"
    assert dull.sun.max() == cloudy.sun.max() == 0.0
    assert cloudy.sun_zenith == 50.0
    assert cloudy.sky.mean() < dull.sky.mean()
    assert [each.name for each in chosen_atmospheres(parts, ["cloudy", "flat", "cloudy"])] == [
        "cloudy",
        "flat",
    ]
    assert chosen_atmospheres(parts, []) == parts.atmospheres
    assert "flat, dull, cloudy" in str(
        expect_error(SchemaError, "choice-unknown", lambda: chosen_atmospheres(parts, ["noon"]))
    )


@pytest.mark.parametrize(
    ("old", "new", "text", "code"),
    [
        (
            "lines = 4",
            "lines = 0",
            "[platform] lines = 0, expected a whole number from 1 to ",
            "value-out-of-range",
        ),
        ("lines = 4", "lines = 1000000000000", "lines = 1000000000000", "value-out-of-range"),
        ("lines = 4", f"lines = 0x{'f' * 5000}", "a number of thousands of digits", "value-out-of-range"),
        ("lines = 4\n", "", "[platform] lines is missing", "key-missing"),
        ("lines = 4", "line = 4", "'line'; did you mean 'lines'?", "key-unknown"),
        ("lines = 4\ncolumns = 3", "lines = 900_000\ncolumns = 20_000", "4.9e+12 samples", "cube-too-large"),
        ("lines = 4", "lines = 4\naltitude_m = nan", "altitude_m = nan", "not-finite"),
        (
            "lines = 4",
            "lines = 4\naltitude_m = 1e200",
            "altitude_m = 1e+200, expected a number from 0.1",
            "value-out-of-range",
        ),
        ("lines = 4", "lines = 4\nwobble_deg = [1, 2]", "or a list of 3 numbers", "length-mismatch"),
        ("lines = 4", "lines = 4\nifov_mrad = 1\nground_sample_m = 1", "ifov_mrad = 1", "option-conflict"),
        ("lines = 4", "lines = 4\nstart_time = 1066-10-14", "start_time = 1066-10-14", "type-wrong"),
        ('kind = "plane"', 'kind = "plain"', "one of car_park, plane, empty", "choice-unknown"),
        ('kind = "plane"', 'kind = "plane"\nrows = 2', "rows with kind = 'plane'", "key-misplaced"),
        ('kind = "plane"', 'kind = "car_park"', "spectrum with kind = 'car_park'", "key-misplaced"),
        ('kind = "plane"\nspectrum = "asphalt"', 'kind = "empty"', "[[meshes]]", "scene-empty"),
        ('[scene]\nkind = "plane"\nspectrum = "asphalt"', "", "no [scene] and no [[meshes]]", "scene-empty"),
        (
            'kind = "plane"\nspectrum = "asphalt"',
            "length_m = 2000\nleaves = 100_000",
            "at most 5e+06",
            "scene-too-large",
        ),
        ("[scene]", "[[scene]]", "expected [scene]", "table-shape"),
        ("[scene]", "[scenes]", "'scenes'; did you mean 'scene'?", "key-unknown"),
        ("[scene]", "[scene", "scene.toml", "toml-unreadable"),
        ("[platform]", "[camera]\nbit_depth = 12.5\n[platform]", "bit_depth = 12.5", "type-wrong"),
        ("[platform]", "[camera]\nfwhm_nm = -1\n[platform]", "fwhm_nm = -1", "value-out-of-range"),
        (
            "[platform]",
            "[camera]\nfirst_wavelength_nm = 20\n[platform]",
            "first_wavelength_nm = 20",
            "value-out-of-range",
        ),
        ("[platform]", "[sampling]\nsamples = 0\n[platform]", "samples = 0", "value-out-of-range"),
        ("[platform]", "[output]\nproduct = 'reflectance'\n[platform]", "radiance, counts", "choice-unknown"),
        ("[platform]", "[spectra]\nmine = 'mine.csv'\n[platform]", "mine = 'mine.csv'", "file-not-found"),
        ("[platform]", "[paints]\nred = 3\n[platform]", "[paints] red = 3, expected a text", "type-wrong"),
        (
            "[platform]",
            "[[meshes]]\npath = 'no.obj'\nspectrum = 'red'\n[platform]",
            "'no.obj'",
            "file-not-found",
        ),
        ("[platform]", "[[meshes]]\npath = 'scene.toml'\n[platform]", "[[meshes]] 1 spectrum", "key-missing"),
        ("[platform]", "[[meshes]]\npath = 'scene.toml'\nspectrum = 'red'\n[platform]", "format-unknown", ""),
        (
            "[platform]",
            "[[meshes]]\npath = 'scene.toml'\nmaterials = { a = { spectrum = 'b', colour = 1 } }\n[platform]",
            "materials.a unknown key 'colour'",
            "key-unknown",
        ),
        ("[platform]", "[[atmospheres]]\nname = 'dusk'\n[platform]", "name = 'dusk'", "choice-unknown"),
        (
            "[platform]",
            "[[atmospheres]]\npreset = 'noon'\nname = '../x'\n[platform]",
            "'../x'",
            "name-invalid",
        ),
        (
            "[platform]",
            "[[atmospheres]]\npreset = 'noon'\n" * 2 + "[platform]",
            "'noon' is given to 2",
            "name-duplicate",
        ),
        (
            "[platform]",
            "[[atmospheres]]\nname = 'a'\ntable = 'scene.toml'\n[platform]",
            "sun_zenith_deg",
            "key-missing",
        ),
        (
            "[platform]",
            "[[atmospheres]]\npreset = 'noon'\ntable = 'scene.toml'\n[platform]",
            "preset and table",
            "option-conflict",
        ),
        (
            "[platform]",
            "[[atmospheres]]\nname = 'a'\ntable = 'scene.toml'\nsun_zenith_deg = 9\n[platform]",
            "a: ",
            "",
        ),
        (
            "[platform]",
            "[[atmospheres]]\npreset = 'noon'\noktas = 9\n[platform]",
            "oktas = 9",
            "value-out-of-range",
        ),
        (
            "[platform]",
            "[[atmospheres]]\npreset = 'noon'\ntime = 'now'\n[platform]",
            "time without",
            "key-misplaced",
        ),
        (
            "[platform]",
            "[[atmospheres]]\nname = 'a'\nirradiance = '*.nix'\n[platform]",
            "'*.nix'",
            "file-not-found",
        ),
    ],
)
def test_one_problem_at_a_time(write: Write, old: str, new: str, text: str, code: str) -> None:
    assert old in SMALL
    message = refused(write(SMALL.replace(old, new)))
    assert text in message
    assert not code or f"[{code}]" in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (SMALL.replace("lines = 4", "lines = -1\nheight = 3") + "[sampling]\ndepth = 0\n",
         ("lines = -1", "'height'", "depth = 0")),
        ("[scene]\ncoat_gloss = 100\n[platform]\nlines = 4\ncolumns = 3\n"
         "[spectra]\nmine = 'scene.toml'\n[[meshes]]\npath = 'scene.toml'\nspectrum = 'red'\n",
         ("[scene]", "[spectra]", "gloss is 100.0 units")),
    ],
)  # fmt: skip
def test_all_problems_come_in_one_message(write: Write, text: str, words: tuple[str, ...]) -> None:
    expect_words(refused(write(text)), *words)


def test_a_narrow_car_park_comes_with_the_other_problems(write: Write) -> None:
    caught = expect_error(
        FormatError,
        None,
        lambda: read_scene_file(
            write("[scene]\nwidth_m = 3\nrows = 2\n[platform]\nlines = 0\ncolumns = 3\n")
        ),
    )
    narrow, lines = sorted(caught.problems, key=lambda problem: problem.code)
    assert ((narrow.found, narrow.code), lines.found) == (
        ("[scene] width_m = 3", "car-park-too-narrow"),
        "[platform] lines = 0",
    )


def test_suns_are_counted_before_the_scene_is_built(write: Write) -> None:
    lights = [f"[[atmospheres]]\nname = 'a{zenith}'\npreset = 'noon'\nsun_zenith_deg = {zenith}\n"
              for zenith in range(20, 27)]  # fmt: skip
    read_scene_file(write(SMALL + "".join(lights[:6]) + "[[atmospheres]]\npreset = 'noon'\n"))
    expect_error(
        FormatError,
        r"7 suns, expected 1 to 6; .*sun-number",
        lambda: read_scene_file(write(SMALL + "".join(lights))),
    )


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"[scene]\nname = '\xff'", b"\0" * 100])
def test_files_that_are_no_text_are_refused(tmp_path: Path, content: bytes) -> None:
    path = write_file(tmp_path / "scene.toml", content)
    refused(path)


def test_folders_and_long_files_are_refused(tmp_path: Path) -> None:
    assert "folder" in refused(tmp_path)
    path = write_file(tmp_path / "long.toml", b"#" * (2 << 20))
    assert "at most" in refused(path)
    path.write_bytes(b"a" + b".a" * 20_000 + b" = 1")
    assert "64 parts" in refused(path)


@given(st.data())
def test_mutated_files_raise_only_our_errors(tmp_path: Path, data: st.DataObject) -> None:
    text = bytearray(example_scene().encode())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(text) - 1))
        text[place : place + data.draw(st.integers(0, 6))] = data.draw(st.binary(max_size=6))
    path = write_file(tmp_path / "scene.toml", bytes(text))
    with contextlib.suppress(FormatError):
        read_scene_file(path)


# --- spectra -----------------------------------------------------------------------------------------------


def test_spectra_are_read_whatever_separates_their_columns(tmp_path: Path) -> None:
    path = write_file(
        tmp_path / "mine.csv", "wavelength [nm], reflectance\n# measured\n400; 0.1\n\n500\t0.2\n600,0.3\n"
    )
    wavelength, reflectance = read_spectrum_csv(path)
    assert wavelength.dtype == reflectance.dtype == np.float64
    assert (wavelength.tolist(), reflectance.tolist()) == ([400.0, 500.0, 600.0], [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "0 lines of numbers"),
        ("400,0.1\n", "1 lines of numbers"),
        ("400,0.1\n400,0.2\n", "do not increase"),
        ("400,0.1\n500,nan\n", "not finite"),
        ("0.4,0.1\n0.5,0.2\n", "expected nanometres"),
        ("400,0.1\n500\n600,0.3\n", "line 2: '500'"),
        ("400,0.1\nfive,0.2\n", "line 2: 'five,0.2'"),
    ],
)
def test_spectra_that_are_none_are_refused(tmp_path: Path, text: str, problem: str) -> None:
    path = write_file(tmp_path / "mine.csv", text)
    expect_error(FormatError, re.escape(problem), lambda: read_spectrum_csv(path))


@given(st.binary(max_size=200))
def test_any_bytes_are_a_spectrum_or_refused(tmp_path: Path, content: bytes) -> None:
    path = write_file(tmp_path / "mine.csv", content)
    try:
        wavelength, values = read_spectrum_csv(path)
    except FormatError:
        return
    assert np.isfinite(wavelength).all()
    assert np.isfinite(values).all()


# --- Wrong keys and values of ``collect.toml`` and ``scene.toml``: each is told once ---

COLLECT = """\
[collect]
name = "day"
[camera]
bit_depth = 12
exposure_time_ms = 5.0
[navigation]
roll_positive = "right_wing_down"
[geometry]
ground = 160.0
[calibration]
path = "calibration.zarr"
[dark]
cubes = "none"
[irradiance]
files = "sky.asd"
utc_offset_h = -5.0
[alignment]
apply = "auto"
[[flightlines]]
id = "raw_0"
cube = "raw_0.hdr"
frame_index = "frameIndex_0.txt"
nav = "imu_gps.txt"
[[references]]
instrument = "svc"
files = "white.sig"
[[panels]]
line = "raw_0"
along_track = [70, 84]
cross_track = [120, 140]
reflectance = 0.5
"""

SCENE = """\
[scene]
kind = "car_park"
length_m = 22.0
[[meshes]]
path = "truck.obj"
spectrum = "red"
[platform]
lines = 20
columns = 16
altitude_m = 15.0
[camera]
bands = 27
fwhm_nm = 6.0
[[atmospheres]]
preset = "noon"
[sampling]
samples = 64
[output]
product = "counts"
"""

EMPTY_SCENE = """\
[scene]
[platform]
lines = 20
columns = 16
[[atmospheres]]
preset = "noon"
[sampling]
"""

SUNS = ((25.0, 180.0),)


def atmosphere(**options: Any) -> Atmosphere:
    grid = np.array([400.0, 1000.0])
    return Atmosphere(grid, grid, grid, grid, grid, **{"sun_zenith": 25.0, "sun_azimuth": 180.0, **options})


FILES = (
    "calibration.zarr",
    "sky.asd",
    "raw_0.hdr",
    "frameIndex_0.txt",
    "imu_gps.txt",
    "white.sig",
    "truck.obj",
)

RELATIVE = "paths count from the folder of this file"
RANGE, CHOICE, TYPE = "value-out-of-range", "choice-unknown", "type-wrong"

# file, line replaced, line instead, found, expected, mend, code
CASES: list[tuple[str, str, str, str, str, str, str]] = [
    ("collect", "bit_depth = 12", "bit_depth = 17", "[camera] bit_depth = 17", "a whole number from 1 to 16",
     "for example bit_depth = 12", RANGE),
    ("collect", "bit_depth = 12", "bit_dept = 12", "[camera] unknown key 'bit_dept'", "",
     "did you mean 'bit_depth'?", "key-unknown"),
    ("collect", "bit_depth = 12", 'bit_depth = "?"', "[camera] bit_depth is still '?'", "",
     "fill in a whole number from 1 to 16", "value-unfilled"),
    ("collect", "exposure_time_ms = 5.0", "exposure_time_ms = -5.0", "[camera] exposure_time_ms = -5.0",
     "a number above 0", "for example exposure_time_ms = 5.0", RANGE),
    ("collect", "exposure_time_ms = 5.0", "exposure_time_ms = inf", "[camera] exposure_time_ms = inf",
     "a number above 0", "for example exposure_time_ms = 5.0", "not-finite"),
    ("collect", "exposure_time_ms = 5.0", 'exposure_time_ms = "5"', "[camera] exposure_time_ms = '5'",
     "a number above 0", "for example exposure_time_ms = 5.0", TYPE),
    ("collect", 'roll_positive = "right_wing_down"', 'roll_positive = "down"',
     "[navigation] roll_positive = 'down'",
     "one of right_wing_down, right_wing_up", 'leave the key out for "right_wing_down"', CHOICE),
    ("collect", 'roll_positive = "right_wing_down"', 'declination = "east"',
     "[navigation] declination = 'east'",
     "a number", "correct it, or leave the key out", TYPE),
    ("collect", "ground = 160.0", "ground = true", "[geometry] ground = True", "a number",
     "for example ground = 160.0", TYPE),
    ("collect", "ground = 160.0", "ground = 1.0\ndem = 'sky.asd'", "[geometry] has ground and dem", "",
     "keep one", "option-conflict"),
    ("collect", "ground = 160.0", "lever_arm_m = [1, 2]", "[geometry] lever_arm_m = [1, 2]", "3 numbers",
     "leave the key out for [0.0, 0.0, 0.0]", "length-mismatch"),
    ("collect", 'path = "calibration.zarr"', 'path = "none.zarr"',
     "[calibration] path = 'none.zarr': no such file",
     "", RELATIVE, "file-not-found"),
    ("collect", 'path = "calibration.zarr"', "", "[calibration] path is missing", "",
     "state path= of a calibration, or sweep= of a lab sweep", "key-missing"),
    ("collect", 'cubes = "none"', "cubes = 3", "[dark] cubes = 3", "a text or a list of texts",
     'for example cubes = ["dark/raw_0.hdr"]', TYPE),
    ("collect", 'files = "sky.asd"', 'files = "*.csv"',
     "[irradiance] files = '*.csv' matches no file", "", RELATIVE,
     "file-not-found"),
    ("collect", "utc_offset_h = -5.0", "utc_offset_h = nan", "[irradiance] utc_offset_h = nan", "a number",
     "for example utc_offset_h = -5.0", "not-finite"),
    ("collect", "utc_offset_h = -5.0", "fwhm_nm = []", "[irradiance] fwhm_nm = []",
     "a positive number, or a list of pairs [wavelength, value]", "for example fwhm_nm = 3.0", TYPE),
    ("collect", 'apply = "auto"', 'apply = "sometimes"', "[alignment] apply = 'sometimes'",
     "one of auto, never, always", 'leave the key out for "auto"', CHOICE),
    ("collect", 'id = "raw_0"', 'id = "../raw"', "[[flightlines]] 1 id = '../raw'",
     "letters, digits, '.', '_' and '-'; not zarr.json or c, names of Zarr's own",
     "choose a name that can name a group of the store", "name-invalid"),
    ("collect", 'instrument = "svc"', "", "[[references]] 1 instrument is missing", "",
     "state the name of the field spectrometer", "key-missing"),
    ("collect", "reflectance = 0.5", "reflectance = 50.0", "[[panels]] 1 reflectance = 50.0",
     "a number above 0 and at most 1.2", "for example reflectance = 0.5", RANGE),
    ("collect", "along_track = [70, 84]", "along_track = [84, 70]", "[[panels]] 1 along_track = [84, 70]",
     "two whole numbers: the first index, and the index after the last",
     "for example along_track = [70, 84]", TYPE),
    ("collect", "[collect]", "[colect]", "unknown table or key 'colect'", "", "did you mean 'collect'?",
     "key-unknown"),
    ("collect", "[alignment]", "[[alignment]]", "'alignment' is [{'apply': 'auto'}]",
     "[alignment]", "write it once",
     "table-shape"),
    ("scene", 'kind = "car_park"', 'kind = "carpark"',
     "[scene] kind = 'carpark'", "one of car_park, plane, empty",
     'leave the key out for "car_park"', CHOICE),
    ("scene", "length_m = 22.0", "length_m = 0", "[scene] length_m = 0", "a number above 0 and at most 10000",
     "leave the key out for 50.0", RANGE),
    ("scene", "length_m = 22.0", 'neighbours = ["tree"]', "[scene] neighbours = ['tree']",
     "a list of some of trees, walls, hedges, lamps", 'leave the key out for ["trees", "walls", "lamps"]',
     CHOICE),
    ("scene", "length_m = 22.0", "size_m = 3.0", "[scene] size_m with kind = 'car_park'", "kind = plane",
     "remove the key, or change the kind", "key-misplaced"),
    ("scene", "length_m = 22.0", "coat_index = 4", "[scene] coat_index = 4", "a number from 1.001 to 3",
     "correct it, or leave the key out", RANGE),
    ("scene", 'spectrum = "red"', "", "[[meshes]] 1 spectrum is missing", "",
     "name a spectrum, or materials, part by part", "key-missing"),
    ("scene", 'spectrum = "red"', 'materials = { glass = { spectrum = "glass", flakes = 2 } }',
     "[[meshes]] 1 materials.glass.flakes = 2", "a number from 0 to 1",
     "correct it, or leave the key out", RANGE),
    ("scene", "lines = 20", "lines = 2.5",
     "[platform] lines = 2.5", "a whole number from 1 to 1000000", "correct it",
     TYPE),
    ("scene", "altitude_m = 15.0", "altitude_m = 0",
     "[platform] altitude_m = 0", "a number from 0.1 to 100000",
     "leave the key out for 15.0", RANGE),
    ("scene", "altitude_m = 15.0", "ifov_mrad = 2000.0", "[platform] ifov_mrad = 2000.0",
     "a number from 0.0001 to 1000", "correct it, or leave the key out", RANGE),
    ("scene", "altitude_m = 15.0", "exposure_time_ms = 9.0", "[platform] exposure_time_ms = 9.0 exceeds "
     "[platform] frame_period_ms = 7.0", "", "shorten the exposure, or lengthen the period",
     "exposure-too-long"),
    ("scene", "altitude_m = 15.0", "speed_m_s = 2\nline_spacing_m = 0.1",
     "[platform] speed_m_s = 2 and [platform] line_spacing_m = 0.1", "one of them", "keep one",
     "option-conflict"),
    ("scene", "fwhm_nm = 6.0", "nonuniformity = 5.0",
     "[camera] nonuniformity = 5.0", "a number from 0 to 0.2",
     "leave the key out for 0.02", RANGE),
    ("scene", "fwhm_nm = 6.0", "first_wavelength_nm = 900.0\nlast_wavelength_nm = 500.0",
     "[camera] first_wavelength_nm = 900.0", "less than [camera] last_wavelength_nm = 500.0", "swap them",
     "band-order"),
    ("scene", "fwhm_nm = 6.0", "masked_columns = 8", "[camera] masked_columns = 8 at both edges",
     "fewer than the 16 columns of the camera", "mask fewer columns", RANGE),
    ("scene", "fwhm_nm = 6.0", "dark_level = 4095",
     "[camera] dark_level = 4095 with [camera] dark_rate = 0.0 and "
     "[camera] pedestal = 0.0", "less than the 4095 counts of 12 bits", "lower the dark, or take more bits",
     "dark-saturated"),
    ("scene", 'preset = "noon"', 'preset = "dusk"', "[[atmospheres]] 1 preset = 'dusk'",
     "one of noon, near_sunset, cloudy", "correct it, or leave the key out", CHOICE),
    ("scene", 'preset = "noon"', 'preset = "noon"\noktas = 9',
     "[[atmospheres]] 1 oktas = 9", "a number from 0 to 8",
     "correct it, or leave the key out", RANGE),
    ("scene", "samples = 64", "samples = 0", "[sampling] samples = 0", "a whole number from 1 to 16384",
     "leave the key out for 64", RANGE),
    ("scene", 'product = "counts"', 'product = "reflectance"', "[output] product = 'reflectance'",
     "one of radiance, counts", 'leave the key out for "radiance"', CHOICE),
]  # fmt: skip

# table, line in it, call with the same value, expected, code
DOORS: list[tuple[str, str, Callable[[], Any], str, str]] = [
    ("[sampling]", "samples = 0", lambda: TraceSettings(SUNS, samples=0), "a whole number from 1 to 16384",
     RANGE),
    ("[sampling]", "depth = 33", lambda: TraceSettings(SUNS, depth=33), "a whole number from 1 to 32", RANGE),
    ("[sampling]", "slots = 4097", lambda: TraceSettings(SUNS, slots=4097), "a whole number from 1 to 4096",
     RANGE),
    ("[sampling]", "seed = 1.5", lambda: TraceSettings(SUNS, seed=1.5),  # type: ignore[arg-type]
     "a whole number from 0 to 9223372036854775807", TYPE),
    ("[sampling]", "sun_radius_deg = nan", lambda: TraceSettings(SUNS, sun_radius=float("nan")),
     "a number from 0 to 45", "not-finite"),
    ("[scene]", "length_m = 0.0", lambda: car_park(length=0.0), "a number above 0 and at most 10000", RANGE),
    ("[scene]", "width_m = 'wide'", lambda: car_park(width="wide"),  # type: ignore[arg-type]
     "a number above 0 and at most 10000", TYPE),
    ("[scene]", "width_m = 8.0", lambda: car_park(width=8.0), "11.0 m or more for 1 rows of bays",
     "car-park-too-narrow"),
    ("[scene]", "rows = 0", lambda: car_park(rows=0), "a whole number from 1 to 199", RANGE),
    ("[scene]", "occupancy = 1.5", lambda: car_park(occupancy=1.5), "a number from 0 to 1", RANGE),
    ("[scene]", "paints = []", lambda: car_park(paints=[]), "at least one name", "empty-input"),
    ("[scene]", "fleet = 'old'", lambda: car_park(fleet="old"), "one of solid, real", CHOICE),
    ("[scene]", "types = ['tank']", lambda: car_park(types=["tank"]),
     "a list of some of sedan, hatchback, estate, suv, van, pickup", CHOICE),
    ("[scene]", "neighbours = ['sea']", lambda: car_park(neighbours=["sea"]),
     "a list of some of trees, walls, hedges, lamps", CHOICE),
    ("[scene]", "panels = 1", lambda: car_park(panels=1), "true or false", TYPE),  # type: ignore[arg-type]
    ("[scene]", "line_width_m = 0.01", lambda: car_park(line_width=0.01), "a number from 0.02 to 1", RANGE),
    ("[scene]", "leaves = -1", lambda: car_park(leaves=-1), "a whole number from 0 to 100000", RANGE),
    ("[scene]", "margin_m = inf", lambda: car_park(margin=float("inf")), "a number from 0 to 10000",
     "not-finite"),
    ("[scene]", "seed = -1", lambda: car_park(seed=-1),
     "a whole number from 0 to 9223372036854775807", RANGE),
    ("[scene]", "coat_index = 1.0", lambda: Coat(index=1.0), "a number from 1.001 to 3", RANGE),
    ("[scene]", "coat_roughness = nan", lambda: Coat(roughness=float("nan")), "a number from 0 to 1",
     "not-finite"),
    ("[scene]", "coat_waviness_deg = 6", lambda: Coat(waviness=6), "a number from 0 to 5", RANGE),
    ("[[atmospheres]]", "sun_zenith_deg = 90.0", lambda: atmosphere(sun_zenith=90.0), "a number from 0 to 89",
     RANGE),
    ("[[atmospheres]]", "sun_zenith_deg = '60'", lambda: atmosphere(sun_zenith="60"), "a number from 0 to 89",
     TYPE),
    ("[[atmospheres]]", "sun_azimuth_deg = 400.0", lambda: atmosphere(sun_azimuth=400.0),
     "a number from -360 to 360", RANGE),
    ("[[atmospheres]]", "overcast_share = 1.5", lambda: atmosphere(overcast_share=1.5),
     "a number from 0 to 1", RANGE),
    ("[[atmospheres]]", "aerosol = -0.1", lambda: Atmosphere.clear(aerosol=-0.1), "a number from 0 to 10",
     RANGE),
    ("[[atmospheres]]", "water = inf", lambda: Atmosphere.clear(water=float("inf")), "a number from 0 to 100",
     "not-finite"),
    ("[[atmospheres]]", "oktas = 9", lambda: atmosphere().clouded(9), "a number from 0 to 8", RANGE),
]  # fmt: skip

READERS: dict[str, tuple[str, Callable[..., Any]]] = {
    "collect": (COLLECT, read_collect),
    "scene": (SCENE, read_scene_file),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in FILES:
        (tmp_path / name).touch()
    return tmp_path


def refusal(folder: Path, kind: str, text: str) -> PaintError:
    path = write_file(folder / f"{kind}.toml", text, encoding="utf-8")
    return expect_error(PaintError, None, lambda: READERS[kind][1](path))


@pytest.mark.parametrize("kind", READERS)
def test_the_files_are_right_without_the_fault(folder: Path, kind: str) -> None:
    text, read = READERS[kind]
    (folder / f"{kind}.toml").write_text(text, encoding="utf-8")
    read(folder / f"{kind}.toml")


@pytest.mark.parametrize(("kind", "line", "instead", "found", "expected", "mend", "code"), CASES)
def test_a_fault_is_told_once(
    folder: Path, kind: str, line: str, instead: str, found: str, expected: str, mend: str, code: str
) -> None:
    text = READERS[kind][0]
    assert f"{line}\n" in text
    error = refusal(folder, kind, text.replace(f"{line}\n", f"{instead}\n", 1))
    (problem,) = error.problems
    assert (problem.expected, problem.mend, problem.code) == (expected, mend, code)
    assert problem.found == found or re.match(re.escape(found) + r"( \(| in )/", problem.found)
    assert problem.expected or problem.mend
    assert f"{kind}.toml cannot be" in str(error)
    assert kind == "collect" or "collect " not in str(error).replace(str(folder), "")


@pytest.mark.parametrize(("table", "line", "call", "expected", "code"), DOORS)
def test_a_file_and_a_call_have_the_same_ranges(
    folder: Path, table: str, line: str, call: Callable[[], Any], expected: str, code: str
) -> None:
    (in_file,) = refusal(folder, "scene", EMPTY_SCENE.replace(f"{table}\n", f"{table}\n{line}\n")).problems
    (in_call,) = expect_error(SchemaError, None, lambda: call()).problems
    assert in_file.found == f"{table}{' 1' * table.startswith('[[')} {line}"
    assert (in_file.expected, in_file.code) == (in_call.expected, in_call.code) == (expected, code)


@pytest.mark.parametrize("kind", READERS)
def test_all_faults_come_in_one_error(folder: Path, kind: str) -> None:
    text = READERS[kind][0]
    wrong = {
        line: (instead, code)
        for file, line, instead, found, *_, code in CASES
        if file == kind and code in (RANGE, TYPE) and "both edges" not in found
    }
    for line, (instead, _) in wrong.items():
        text = text.replace(f"{line}\n", f"{instead}\n", 1)
    assert sorted(code for code in refusal(folder, kind, text).codes if code in (RANGE, TYPE)) == sorted(
        code for _, code in wrong.values()
    )


def test_a_message_is_one_sentence(folder: Path) -> None:
    message = str(refusal(folder, "scene", SCENE.replace("fwhm_nm = 6.0", "nonuniformity = 5.0")))
    assert re.sub(r"^.*?\[camera\]", "[camera]", message, flags=re.DOTALL) == (
        f"[camera] nonuniformity = 5.0, expected a number from 0 to 0.2; leave the key out for 0.02 [{RANGE}]"
    )


# --- Whose paints the scene of a file gets when it is written for DIRSIG ---

NM = np.linspace(400.0, 1000.0, 31)
SCENE_DIRSIG = """
[scene]
kind = "car_park"
fleet = "solid"
length_m = 12.0
neighbours = []
seed = 3
[platform]
lines = 4
columns = 4
altitude_m = 15.0
ground_sample_m = 0.1
[camera]
first_wavelength_nm = 410.0
last_wavelength_nm = 990.0
"""


def library(*names: str) -> xr.Dataset:
    values = np.linspace(0.1, 0.5, len(names))[:, None] * np.ones_like(NM)
    return xr.Dataset(
        {"reflectance": (("signature", "band"), values.astype(np.float32), {"units": "1"})},
        {"signature": list(names), "wavelength": ("band", NM, {"units": "nm"})},
    )


def exported(tmp_path: Path, text: str, paints: xr.Dataset | None = None) -> dict[str, int]:
    (tmp_path / "scene.toml").write_text(text)
    summary = export_dirsig_scene(tmp_path / "scene.toml", tmp_path / "out", paints)
    return dict(zip(summary["signature"].values.tolist(), summary["faces"].values.tolist(), strict=True))


def test_foreign_names_are_dealt_to_the_cars(tmp_path: Path) -> None:
    faces = exported(tmp_path, SCENE_DIRSIG, library("roof 7", "roof 8"))
    assert min(faces["roof 7"], faces["roof 8"]) > 0
    assert "asphalt" in faces


def test_without_a_library_built_in_spectra_and_those_of_the_file_are_written(tmp_path: Path) -> None:
    rows = "".join(f"{nm:.1f},0.3\n" for nm in NM)
    (tmp_path / "mine.csv").write_text("wavelength,reflectance\n" + rows)
    faces = exported(tmp_path, SCENE_DIRSIG + '[spectra]\nmine = "mine.csv"\n[paints]\nasphalt = "mine"\n')
    assert faces["mine"] > 0
    expect_words(faces, "glass", "painted_line", without=("asphalt",))


def test_paints_of_libraries_in_a_file_have_its_names() -> None:
    spectra: dict[str, Any] = {"mine": library("a", "b"), "one": library("c"), "flat": (NM, NM)}
    names = [each["signature"].values.tolist() for each in named_libraries(spectra)]
    assert names == [["mine/a", "mine/b"], ["one/c"], ["one"]]


def test_an_unknown_paint_is_named(tmp_path: Path) -> None:
    expect_error(
        SchemaError,
        "'no such paint'",
        lambda: exported(tmp_path, SCENE_DIRSIG + '[paints]\nasphalt = "no such paint"\n'),
    )


# --- Every library that hyperpaint writes is rendered as it is ---

BANDS = BandSet(np.linspace(420.0, 980.0, 29), np.array(6.0))
NAMES = ["red, matt", "Türkis", "white"]

Write_rendered = Callable[[xr.Dataset, Path], Path]


def library_rendered() -> xr.Dataset:
    # Return three paints with populations
    paints = starter_library(members=4).isel(signature=[5, 9, 0])
    return paints.assign_coords(signature=("signature", np.array(NAMES, object)))


def export(**options: str) -> Write_rendered:
    def write(paints: xr.Dataset, place: Path) -> Path:
        return hp.write_library(paints, place, **options)

    return write


def dirsig(part: str, **options: str) -> Write_rendered:
    def write(paints: xr.Dataset, place: Path) -> Path:
        hp.write_dirsig(paints, place, **options)
        return place / part

    return write


@pytest.mark.parametrize(
    ("name", "write", "paints"),
    [
        ("x.zarr", export(), NAMES),
        ("x.sli", export(), NAMES),
        ("x.sli", export(curves="all"), NAMES),
        ("x.csv", export(), NAMES),
        ("x", dirsig(""), NAMES),
        ("x", dirsig("materials.mat"), NAMES),
        ("x", dirsig("materials.mat", surface="SimpleReflectance"), NAMES),
        ("x", dirsig("emissivity/Tuerkis.ems"), ["Tuerkis"]),
        ("x", dirsig("reflectance/Tuerkis.txt"), ["Tuerkis"]),
    ],
)
def test_every_export_gives_its_paints_back(
    tmp_path: Path, name: str, write: Write_rendered, paints: list[str]
) -> None:
    truth = library_rendered()
    path = write(truth, tmp_path / name)
    read = by_name(read_paints(path))
    assert sorted(read) == sorted(paints)
    record = SceneRecord.of(two_cars())
    for paint, place in zip(paints, [1] if len(paints) == 1 else range(3), strict=True):
        spectra = factor_spectra(record, BANDS, {"car_0": paint}, read)
        one = truth.isel(signature=place)
        # the curves of a single .ems have no centre but their mean
        centre = one.member_reflectance.mean("member") if "ems" in str(path) else one.reflectance
        expected = factor_spectra(record, BANDS, {"car_0": "it"}, {"it": centre})
        nm = np.arange(420.0, 981.0)
        np.testing.assert_allclose(spectra(nm), expected(nm), atol=1.5e-6)


def test_a_library_in_spectra_names_its_paints_behind_its_own(tmp_path: Path) -> None:
    hp.write_library(library_rendered(), tmp_path / "x.zarr")
    mine = {"mine": read_spectra(tmp_path / "x.zarr")}
    record = SceneRecord.of(two_cars())
    assert "mine/Türkis" in factor_spectra(record, BANDS, {"red": "mine/Türkis"}, mine).names
    expect_error(
        SchemaError, "spectrum-unknown", lambda: factor_spectra(record, BANDS, {"red": "mine"}, mine)
    )
    one = {"mine": library_rendered().isel(signature=[1])}
    assert "mine" in factor_spectra(record, BANDS, {"red": "mine"}, one).names


def test_a_digest_follows_every_value() -> None:
    paints = library_rendered()
    other = paints.copy(deep=True)
    other.member_reflectance[2, 3, 7] += 0.01
    plain = np.array([400.0, 900.0]), np.array([0.2, 0.3])
    digests = {spectra_digest(one) for one in ({"a": paints}, {"a": other}, {"b": paints}, {"a": plain})}
    assert (len(digests), spectra_digest({"a": paints})) == (4, spectra_digest({"a": paints.copy(deep=True)}))


def test_bands_without_values_are_named_and_held_on_request() -> None:
    paints = library_rendered().isel(signature=[0])
    nm = paints.wavelength.values
    hole = (nm < 430.0) | ((nm > 755.0) & (nm < 765.0))
    paints["reflectance"] = paints.reflectance.where(xr.DataArray(~hole, dims="band"))
    record = SceneRecord.of(two_cars())
    strict = {"hold_edges": False}
    caught = expect_error(
        SchemaError, None, lambda: factor_spectra(record, BANDS, {"car_0": "red, matt"}, paints, **strict)
    )
    assert caught.codes == ("spectrum-coverage", "not-finite")
    assert "424.4 to 428.8, 756.5 to 763.1 nm" in caught.problems[1].found
    held = factor_spectra(record, BANDS, {"car_0": "red, matt"}, paints, hold_edges=True)
    known = np.interp(np.array([425.0, 760.0]), nm[~hole], paints.reflectance.values[0][~hole])
    np.testing.assert_allclose(held.spectra["red, matt"](np.array([425.0, 760.0])), known, rtol=1e-6)
    # by default the first bands are held, with a warning, and the gap between bands is refused
    whole = paints.where((paints.wavelength < 430.0) | paints.reflectance.notnull(), 0.2)
    with pytest.warns(hp.errors.PaintWarning, match="held constant there, over up to .* nm"):
        factor_spectra(record, BANDS, {"car_0": "red, matt"}, whole)
    expect_error(
        SchemaError, "not-finite", lambda: factor_spectra(record, BANDS, {"car_0": "red, matt"}, paints)
    )
    short = paints.isel(band=slice(60, 200))
    expect_error(
        SchemaError, "spectrum-coverage", lambda: factor_spectra(record, BANDS, {"car_0": "red, matt"}, short)
    )
    bad = library_rendered().isel(signature=[0]).assign_coords(good=("band", nm < 900.0))
    expect_error(
        SchemaError, "spectrum-coverage", lambda: factor_spectra(record, BANDS, {"car_0": "red, matt"}, bad)
    )


def test_what_may_mislead_is_said() -> None:
    paints = library_rendered()
    paints["reflectance"] = paints.reflectance - 0.06
    paints.reflectance.attrs = {"units": "1", "mirror_reflection": "included"}
    record = SceneRecord.of(two_cars())
    with pytest.warns(PaintWarning) as caught:
        factor_spectra(record, BANDS, {"car_0": "red, matt"}, paints)
    texts = [str(one.message) for one in caught]
    assert any("reflectance-clipped" in text for text in texts)
    assert any("mirror-counted-twice" in text for text in texts)


def test_a_library_paints_the_cars_of_a_traced_scene() -> None:
    traced = hp.simulation.trace(two_cars(), flight(), [SUN], samples=4).compute()
    paints = library_rendered().isel(signature=[0, 1])
    dealt = traced.paint.relight(BANDS, paints=paints, atmosphere=flat_light()).radiance
    named = traced.paint.relight(
        BANDS, paints={"car_0": "red, matt", "car_1": "Türkis"}, spectra=paints, atmosphere=flat_light()
    ).radiance
    np.testing.assert_array_equal(dealt.values, named.values)
    expect_error(
        SchemaError,
        "paint-ambiguous",
        lambda: traced.paint.relight(
            BANDS, paints=library_rendered().isel(signature=[0, 0]), atmosphere=flat_light()
        ),
    )


def test_a_coat_that_was_exported_is_no_part_of_the_body(tmp_path: Path) -> None:
    paints = library_rendered()
    hp.write_dirsig(paints, tmp_path / "coated", specular="library")
    hp.write_dirsig(paints, tmp_path / "plain")
    coated, plain = (read_paints(tmp_path / name) for name in ("coated", "plain"))
    assert list(coated) == list(plain) == NAMES
    for name in NAMES:
        for variable in ("reflectance", "member_reflectance"):
            np.testing.assert_allclose(coated[name][variable], plain[name][variable], atol=2e-6)


def test_a_scene_covers_the_bands_of_its_camera(tmp_path: Path) -> None:
    def written(camera: str, **options: Any) -> dict[str, tuple[float, float]]:
        # Return the range of every file of curves and parameters, by a parser of its own
        (tmp_path / "scene.toml").write_text(SCENE_DIRSIG.partition("[camera]")[0] + camera)
        paints = library("roof 7").isel(band=NM < 910.0)
        paints.reflectance.attrs["mirror_reflection"] = "excluded"
        export_dirsig_scene(tmp_path / "scene.toml", tmp_path / "out", paints, overwrite=True, **options)
        ranges = {}
        for path in (tmp_path / "out/materials").glob("*/*"):
            rows = re.findall(r"^(?:    LAMBDA = )?(\d\.\d{7})(?:\t.+)?$", path.read_text(), re.MULTILINE)
            micrometres = np.array(rows, float)
            ranges[f"{path.parent.name}/{path.name}"] = (micrometres.min() * 1e3, micrometres.max() * 1e3)
        return ranges

    # 890 and 910 nm are covered, with 25 nm held at the end
    camera = "[camera]\nbands = 40\nfirst_wavelength_nm = 430.0\nlast_wavelength_nm = 900.0\nfwhm_nm = 20.0\n"
    with pytest.warns(PaintWarning, match="edge-bands-held"):
        ranges = written(camera)
    assert {"emissivity/roof_7.ems", "reflectance/roof_7.txt", "brdf/roof_7.fit"} <= set(ranges)
    for name, (low, high) in ranges.items():
        assert low <= 420.0 + 1e-6, name
        assert high >= 910.0 - 1e-6, name
    far = camera.replace("900.0", "960.0")
    expect_error(SchemaError, "measured 400 to 900 nm, expected 420 to 970 nm", lambda: written(far))
    assert max(high for _, high in written(far + "[output]\nhold_edges = true\n").values()) >= 970.0 - 1e-6
    assert max(high for _, high in written(far, wavelength_range=(450.0, 800.0)).values()) < 1050.0


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("nothing here\n")
    expect_error(FormatError, "table-missing", lambda: read_spectra(tmp_path / "x.csv"))
    hp.write_dirsig(library_rendered(), tmp_path / "d")
    (tmp_path / "d" / "emissivity" / "Tuerkis.ems").unlink()
    expect_error(FormatError, "file-not-found", lambda: read_paints(tmp_path / "d"))


SCENE_RENDERED = """\
[scene]
kind = "car_park"
length_m = 5
width_m = 16
margin_m = 5
neighbours = []
[platform]
lines = 16
columns = 16
ground_sample_m = 0.8
[camera]
bands = 6
fwhm_nm = 30
first_wavelength_nm = 450
last_wavelength_nm = 900
[sampling]
samples = 2
[spectra]
mine = "x.zarr"
[paints]
car_001 = "mine/white"
"""


@pytest.mark.slow  # the tracer is compiled
def test_render_takes_a_library_and_traces_once(tmp_path: Path) -> None:
    hp.write_library(library_rendered(), tmp_path / "x.zarr")
    (tmp_path / "scene.toml").write_text(SCENE_RENDERED)
    arguments = ["render", str(tmp_path / "scene.toml"), "--quiet"]
    hyperpaint(*arguments, status=0)
    again = hyperpaint(*arguments, "--library", tmp_path / "x.zarr", "--overwrite", status=0)
    assert "transport" in again.output
    line = hp.open_store(tmp_path / "scene.zarr", "renders/noon")
    painted = dict(zip(line.paint_id.flag_values, line.paint_id.flag_meanings.split(), strict=True))
    shown = {painted[number] for number in np.unique(line.paint_id) if number >= 0}
    assert {"mine/white", "white"} & shown
    assert shown & {"red,_matt", "Türkis"}
