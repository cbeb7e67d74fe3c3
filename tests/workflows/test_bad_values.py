"""Wrong keys and values of ``collect.toml`` and ``scene.toml``: each is told once."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hyperpaint.base.errors import PaintError, SchemaError
from hyperpaint.io.collect.collect_toml import read_collect
from hyperpaint.simulation.rendering.car_parks import car_park
from hyperpaint.simulation.rendering.four_curves import Atmosphere
from hyperpaint.simulation.rendering.materials import Coat
from hyperpaint.simulation.rendering.scene_record import TraceSettings
from hyperpaint.workflows.scene_files import read_scene_file

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
     "letters, digits, '.', '_' and '-'", "choose a name that can name a group of the store", "name-invalid"),
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
    path = folder / f"{kind}.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(PaintError) as caught:
        READERS[kind][1](path)
    return caught.value


@pytest.mark.parametrize("kind", READERS)
def test_the_files_are_right_without_the_fault(folder: Path, kind: str) -> None:
    text, read = READERS[kind]
    (folder / f"{kind}.toml").write_text(text, encoding="utf-8")
    read(folder / f"{kind}.toml")


def test_there_are_forty() -> None:
    assert len(CASES) >= 40


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
    with pytest.raises(SchemaError) as caught:
        call()
    (in_call,) = caught.value.problems
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
    codes = refusal(folder, kind, text).codes
    assert sorted(code for code in codes if code in (RANGE, TYPE)) == sorted(
        code for _, code in wrong.values()
    )


def test_a_message_is_one_sentence(folder: Path) -> None:
    message = str(refusal(folder, "scene", SCENE.replace("fwhm_nm = 6.0", "nonuniformity = 5.0")))
    assert re.sub(r"^.*?\[camera\]", "[camera]", message, flags=re.DOTALL) == (
        f"[camera] nonuniformity = 5.0, expected a number from 0 to 0.2; leave the key out for 0.02 [{RANGE}]"
    )
