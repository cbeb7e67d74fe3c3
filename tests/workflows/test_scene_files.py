"""What a ``scene.toml`` may say, and what is said of one that cannot be rendered."""

import contextlib
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from support.refusals import expect_words

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.io.spectrometers.spectrum_csv import read_spectrum_csv
from hyperpaint.workflows.scene_files import (
    SceneFile,
    build_parts,
    chosen_atmospheres,
    example_scene,
    read_scene_file,
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
        path = tmp_path / "scene.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return make


def refused(path: Path) -> str:
    with pytest.raises(FormatError) as caught:
        build_parts(read_scene_file(path))
    return str(caught.value)


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
    with pytest.raises(SchemaError, match="choice-unknown") as caught:
        chosen_atmospheres(parts, ["noon"])
    assert "flat, dull, cloudy" in str(caught.value)


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


def test_all_problems_come_in_one_message(write: Write) -> None:
    message = refused(write(SMALL.replace("lines = 4", "lines = -1\nheight = 3") + "[sampling]\ndepth = 0\n"))
    assert [text for text in ("lines = -1", "'height'", "depth = 0") if text not in message] == []


def test_a_narrow_car_park_comes_with_the_other_problems(write: Write) -> None:
    with pytest.raises(FormatError) as caught:
        read_scene_file(write("[scene]\nwidth_m = 3\nrows = 2\n[platform]\nlines = 0\ncolumns = 3\n"))
    narrow, lines = sorted(caught.value.problems, key=lambda problem: problem.code)
    assert ((narrow.found, narrow.code), lines.found) == (
        ("[scene] width_m = 3", "car-park-too-narrow"),
        "[platform] lines = 0",
    )


def test_suns_are_counted_before_the_scene_is_built(write: Write) -> None:
    lights = [f"[[atmospheres]]\nname = 'a{zenith}'\npreset = 'noon'\nsun_zenith_deg = {zenith}\n"
              for zenith in range(20, 27)]  # fmt: skip
    read_scene_file(write(SMALL + "".join(lights[:6]) + "[[atmospheres]]\npreset = 'noon'\n"))
    with pytest.raises(FormatError, match=r"7 suns, expected 1 to 6; .*sun-number"):
        read_scene_file(write(SMALL + "".join(lights)))


def test_problems_of_what_is_built_come_in_one_message(write: Write) -> None:
    message = refused(
        write(
            "[scene]\ncoat_gloss = 100\n[platform]\nlines = 4\ncolumns = 3\n"
            "[spectra]\nmine = 'scene.toml'\n[[meshes]]\npath = 'scene.toml'\nspectrum = 'red'\n"
        )
    )
    assert [text for text in ("[scene]", "[spectra]", "gloss is 100.0 units") if text not in message] == []


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"[scene]\nname = '\xff'", b"\0" * 100])
def test_files_that_are_no_text_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    refused(path)


def test_folders_and_long_files_are_refused(tmp_path: Path) -> None:
    assert "folder" in refused(tmp_path)
    path = tmp_path / "long.toml"
    path.write_bytes(b"#" * (2 << 20))
    assert "at most" in refused(path)
    path.write_bytes(b"a" + b".a" * 20_000 + b" = 1")
    assert "64 parts" in refused(path)


@settings(max_examples=60)
@given(st.data())
def test_mutated_files_raise_only_our_errors(tmp_path: Path, data: st.DataObject) -> None:
    text = bytearray(example_scene().encode())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(text) - 1))
        text[place : place + data.draw(st.integers(0, 6))] = data.draw(st.binary(max_size=6))
    path = tmp_path / "scene.toml"
    path.write_bytes(bytes(text))
    with contextlib.suppress(FormatError):
        read_scene_file(path)


# --- spectra -----------------------------------------------------------------------------------------------


def test_spectra_are_read_whatever_separates_their_columns(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text("wavelength [nm], reflectance\n# measured\n400; 0.1\n\n500\t0.2\n600,0.3\n")
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
    path = tmp_path / "mine.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match=re.escape(problem)):
        read_spectrum_csv(path)


@settings(max_examples=50)
@given(st.binary(max_size=200))
def test_any_bytes_are_a_spectrum_or_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mine.csv"
    path.write_bytes(content)
    try:
        wavelength, values = read_spectrum_csv(path)
    except FormatError:
        return
    assert np.isfinite(wavelength).all()
    assert np.isfinite(values).all()
