"""What goes into a signature: flags, smoothing, corrections, several lines; and the library it makes."""

import json
import warnings
from pathlib import Path
from typing import Any

import dask
import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from oracles.disort_sky import relative_sky
from scipy.spatial.transform import Rotation
from support.painted_lines import CHUNKINGS, RAW, SPECTRA, TWO, assert_same_bits, made, raw
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint import Quality, Region, Regions, SchemaError, extract_signatures
from hyperpaint.base.attitude_conventions import Convention
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.schema import CUBE, LIBRARY_VARIABLES, VARIABLES
from hyperpaint.light.clear_sky import sunward_gain
from hyperpaint.light.diffuse_record import SKY_STATES
from hyperpaint.light.sun import diffuse_fraction, solar_position
from hyperpaint.paints.signatures.extraction import (
    change_over_crown,
    flop_of,
    strength_of,
    with_aspecular_geometry,
)
from hyperpaint.paints.signatures.pixel_statistics import summarise
from hyperpaint.regions import pixels, regions_from

# --- flags, smoothing and refusals -------------------------------------------------------------------------


def test_excluded_flags_are_the_users_choice() -> None:
    line = made()
    everything = extract_signatures(line, TWO, exclude=0)
    assert (everything.n_excluded == 0).all()
    assert (everything.quality.values.tolist(), everything.attrs["exclude"]) == ([64 | 32] * 2, "none")
    strict = extract_signatures(line, TWO, exclude=Quality.GLINT | Quality.LOW_SUN)
    assert (strict.n < extract_signatures(line, TWO).n).all()
    assert strict.attrs["exclude"] == "low_sun glint"
    assert (extract_signatures(line.drop_vars("quality"), TWO).n_excluded == 0).all()
    line["reflectance"].values[5, :, 3] = np.nan
    line["quality"].values[:] = 0
    assert extract_signatures(line, TWO).n_excluded.values.tolist() == [1, 0]


@pytest.mark.parametrize("flag", [Quality.ILLUMINATION_UNSTABLE, Quality.TIMING_SENSITIVE])
def test_lines_of_unsteady_light_are_excluded_where_others_remain(flag: Quality) -> None:
    line = made()
    line["quality"].values[:] = 0
    steady = extract_signatures(line, TWO)
    line["quality"].values[::2] = int(flag)
    halved = extract_signatures(line, TWO)
    assert (halved.n < 0.7 * steady.n).all()
    assert str(flag.name).lower() in halved.attrs["exclude"]
    assert not halved.quality.any()
    line["quality"].values[:] = int(flag)
    with pytest.warns(PaintWarning, match="light-unsteady"):
        unsteady = extract_signatures(line, TWO)
    np.testing.assert_array_equal(unsteady.reflectance, steady.reflectance)
    assert (unsteady.quality == int(flag)).all()
    expect_error(SchemaError, "region-too-small", lambda: extract_signatures(line, TWO, exclude=flag))


def test_flags_that_were_never_searched_are_not_called_excluded() -> None:
    line = made()
    line["quality"].values[:] = 0
    with pytest.warns(PaintWarning, match="flags-not-searched"):
        library = extract_signatures(line, TWO)
    assert (
        library.attrs["exclude"] == "saturated irradiance_gap illumination_unstable no_data timing_sensitive"
    )
    line["quality"].attrs["flags_from"] = "a survey"
    assert "glint shadow adjacency mixed_edge" in extract_signatures(line, TWO).attrs["exclude"]
    assert extract_signatures(line.drop_vars("quality"), TWO).attrs["exclude"] == "none"


def test_all_regions_with_too_few_pixels_are_named() -> None:
    line = made()
    line["quality"].values[:] = int(Quality.SHADOW)
    told = str(expect_error(SchemaError, None, lambda: extract_signatures(line, TWO)))
    for region in TWO:
        size = pixels(region, line)[0].size
        assert f"{region.name!r}: 0 of {size} pixels are usable, expected 5 (100% shadow)" in told, told
    beyond = Regions(
        (TWO[0], Region("far", [(90, 90), (99, 90), (99, 99)]), Region("off", [(90, 0), (99, 0), (99, 9)]))
    )
    expect_error(SchemaError, r"(?s)'far'.*40 l.*'off'", lambda: extract_signatures(line, beyond))


def test_a_region_with_too_few_pixels_is_dropped_on_request(tmp_path: Path) -> None:
    line = made()
    cells = pixels(TWO[0], line)
    line["quality"].values[cells] |= int(Quality.SHADOW)
    expect_error(SchemaError, "region-too-small", lambda: extract_signatures(line, TWO))
    library = extract_signatures(line, TWO, drop_small=True)
    assert library.equals(extract_signatures(line, TWO[1:]))
    (said,) = library.attrs["left_out"]
    assert f"{TWO[0].name!r}: 0 of {cells[0].size} pixels are usable" in said
    hp.write_library(library, tmp_path / "paints.zarr")
    assert hp.open_library(tmp_path / "paints.zarr").attrs["left_out"] == [said]
    line["quality"].values[:] |= int(Quality.SHADOW)
    expect_error(SchemaError, "region-too-small", lambda: extract_signatures(line, TWO, drop_small=True))


@pytest.mark.parametrize("method", ["savitzky-golay", "box"])
def test_one_bad_band_touches_its_window_only(method: str) -> None:
    line = made()
    line["reflectance"] = line.reflectance.fillna(0.3)
    smoothing = {"method": method, "window": 5}
    whole = extract_signatures(line, TWO, smooth=smoothing)
    holed = line.copy(deep=True)
    holed["reflectance"].values[:, 6, :] = np.nan
    found = extract_signatures(holed, TWO, smooth=smoothing)
    for name in SPECTRA:
        array, before = (library[name].transpose(..., "band").values for library in (found, whole))
        same = np.array([np.array_equal(array[..., k], before[..., k], equal_nan=True) for k in range(12)])
        assert same.tolist() == [True] * 4 + [False] * 5 + [True] * 3, name
        assert np.isfinite(array[..., :6][before[..., :6] == before[..., :6]]).all()
    assert found.attrs["smoothing"].lower().startswith(method)
    assert whole.attrs["smoothing"] != extract_signatures(line, TWO).attrs["smoothing"] == "none"
    expect_error(
        SchemaError,
        "already-smoothed",
        lambda: extract_signatures(line.paint.smooth("box", 3), TWO, smooth="box"),
    )
    assert extract_signatures(line.paint.smooth("box", 3), TWO).attrs["smoothing"] == "box, 3 bands"


# --- corrections -------------------------------------------------------------------------------------------

SMILE = ("wavelength_shift", ("cross_track", np.linspace(-1.0, 1.0, 16), {"units": "nm"}))


@pytest.mark.parametrize("smile", [False, True])
def test_what_was_corrected_is_said(smile: bool) -> None:
    line = made().assign_coords(dict([SMILE] if smile else []))
    tilted = line.assign(reflectance=line.reflectance.assign_attrs(tilt="tilted by 3 degree"))
    removed = hp.surroundings.remove_mirrored_sky(line, sun_zenith=40.0)
    lines = {"a": removed, "b": tilted, "c": line}
    library = extract_signatures(lines, on_lines("a", "b", "c"), smooth="box")
    text = removed.reflectance.attrs["mirrored_sky_removed"]
    assert library.attrs["corrections"] == f"mirrored_sky_removed: {text}; tilt: tilted by 3 degree; none"
    assert library.reflectance.attrs["mirrored_sky_removed"] == f"{text}; none"
    assert library.reflectance.attrs["tilt"] == "none; tilted by 3 degree"
    expect_errors(
        (
            SchemaError,
            r"tilt.*corrected-before",
            lambda: extract_signatures(tilted, TWO, specular_sky=True, sun_zenith=40.0),
        ),
        (
            SchemaError,
            "corrected-before",
            lambda: hp.surroundings.remove_mirrored_sky(library, sun_zenith=40.0),
        ),
    )
    lit = hp.surroundings.correct_light(line, direct=0.9, sun_zenith=40.0)
    assert extract_signatures(lit, TWO).attrs["corrections"].startswith("light_corrected: direct 0.9")
    assert extract_signatures(line, TWO).attrs["corrections"] == "none"
    assert "tilt" not in line.reflectance.attrs


def test_the_mirrored_sky_is_subtracted() -> None:
    line = raw()
    options = {"specular_sky": True, "diffuse": "model", "coat": False}
    seen, less = line.paint.signatures(RAW), line.paint.signatures(RAW, **options)
    nm, suns, views = line.wavelength.values, seen.sun_zenith.values, seen.view_zenith.values
    turned = np.radians(180.0 - seen.relative_azimuth.values)
    # Fresnel's reflectance changes by less than 0.1 % up to 20 degrees
    assert views.max() < 20.0
    taken = np.mean(
        [
            [0.04 * f * float(relative_sky(w, sun, np.cos(np.radians(view)), turn))
             for w, f in zip(nm, diffuse_fraction(nm, sun), strict=True)]
            for sun, view, turn in zip(suns, views, turned, strict=True)
        ],
        axis=0,
    )  # fmt: skip
    assert taken.max() > 0.01
    for name in ("reflectance", "reflectance_quantiles", "member_reflectance"):
        lower = (seen[name] - less[name]).transpose(..., "band").mean("signature").values[..., 1:-1]
        np.testing.assert_allclose(lower, np.broadcast_to(taken[1:-1], lower.shape), atol=2e-5)
    np.testing.assert_allclose(less.reflectance_sd, seen.reflectance_sd, rtol=1e-3)
    low = line.paint.signatures(RAW, sun_zenith=80.0, **options)
    assert (low.reflectance[:, 2] < less.reflectance[:, 2]).all()
    assert "sun zenith 80 degree" in low.attrs["corrections"]
    # the same bits whatever the chunks
    expected = line.paint.signatures(RAW, specular_sky=True, smooth="box")
    for chunks in CHUNKINGS[1:]:
        lazy = line.assign(counts=line.counts.chunk(chunks), time=line.time.chunk(along_track=7))
        assert_same_bits(lazy.paint.signatures(RAW, specular_sky=True, smooth="box"), expected)
    assert expected.attrs["corrections"].startswith("mirrored_sky_removed: F0 0.04")


def test_every_wrong_option_is_told() -> None:
    wrong: dict[str, Any] = {"exclude": "glint", "members": -1, "centre": "mean", "min_pixels": 0}
    words = ("regions= is empty", "exclude='glint'", "members=-1", "centre='mean'", "min_pixels=0")
    error = expect_error(SchemaError, None, lambda: extract_signatures(made(), Regions(()), **wrong))
    expect_words(str(error), *words)
    number: Any = 3
    expect_errors(
        (SchemaError, "type-wrong", lambda: extract_signatures(number, TWO)),
        (
            SchemaError,
            "compute reflectance",
            lambda: extract_signatures(made().drop_vars("reflectance"), TWO),
        ),
        (
            SchemaError,
            "'wavelength' is missing",
            lambda: extract_signatures(made().drop_vars("wavelength"), TWO),
        ),
    )
    # a mirrored sky that cannot be subtracted
    line = made()
    expect_refusals(
        (SchemaError, "sun-unknown", lambda: extract_signatures(line, TWO, specular_sky=True)),
        (SchemaError, "argument-missing", lambda: extract_signatures(line, TWO, sun_zenith=30.0)),
    )
    removed = hp.surroundings.remove_mirrored_sky(line.assign_coords(dict([SMILE])), sun_zenith=40.0)
    expect_error(
        SchemaError,
        "corrected-before",
        lambda: extract_signatures(removed, TWO, specular_sky=True, sun_zenith=40.0),
    )


# --- several lines, and the library ------------------------------------------------------------------------


def on_lines(*names: str) -> Regions:
    return Regions(tuple(Region(f"p{k}", TWO[0].polygon, flightline=name) for k, name in enumerate(names)))


def test_regions_of_several_flight_lines() -> None:
    lines = {"raw_0": made(), "raw_9": made(seed=9).chunk({"along_track": 8}), "raw_18": made(seed=5)}
    regions = on_lines("raw_9", "raw_0", "raw_9")
    library = extract_signatures(lines, regions)
    assert library.flightline.values.tolist() == ["raw_9", "raw_0", "raw_9"]
    for number, region in enumerate(regions):
        alone = extract_signatures(lines[region.flightline].assign_attrs(name=region.flightline), region)
        for name in ("reflectance", "n", "n_eff", "quality_share"):
            np.testing.assert_array_equal(library[name][number], alone[name][0])
    tree = xr.DataTree.from_dict({f"/flightlines/{name}": line for name, line in lines.items()})
    assert_same_bits(extract_signatures(tree, regions), library)
    other = made(seed=1).assign_coords(wavelength=("band", np.linspace(400.0, 901.0, 12), {"units": "nm"}))
    expect_error(
        SchemaError, r"'raw_0'.*bands-differ", lambda: extract_signatures({**lines, "raw_0": other}, regions)
    )


def test_a_region_of_another_line_is_never_taken_for_this_one() -> None:
    expect_errors(
        (SchemaError, r"expected 'raw_0' .flight", lambda: extract_signatures(made(), on_lines("raw_7"))),
        (
            SchemaError,
            r"(?s)p0.*'a' or 'b'.*p1",
            lambda: extract_signatures({"a": made(), "b": made()}, on_lines("", "c")),
        ),
    )
    nameless = made()
    del nameless.attrs["name"]
    assert extract_signatures(nameless, on_lines("raw_7")).n.size == 1
    expect_error(
        SchemaError,
        r"'p1'.*flightline-unknown",
        lambda: extract_signatures(nameless, on_lines("raw_7", "raw_8")),
    )


def test_the_library_is_that_of_the_table() -> None:
    library = extract_signatures(made(), TWO)
    # those of a coat come with its correction, errors by source where their sources are known
    by_source = ("reflectance_errors", "error_correlation", "error_source", "error_form", "lag")
    for name, row in LIBRARY_VARIABLES.items():
        if name in ("coat_transmission", "coat_transmission_u", "reflectance_u_coat", *by_source):
            assert name not in library
            continue
        array = library[name]
        assert array.dims == row.dims, name
        assert array.dtype == (object if row.dtype == "str" else row.dtype), name
        assert row.attrs.items() <= array.attrs.items(), name
        assert (name in library.coords) == row.coordinate, name
    assert set(library.data_vars) <= set(LIBRARY_VARIABLES)
    assert library["colour"].values.tolist() == ["red", ""]
    np.testing.assert_array_equal(library["year"], [2019.0, np.nan])
    assert regions_from(json.loads(library["region"].values[1]))[0] == TWO[1]
    assert library.attrs["regions"] == TWO.digest
    assert library.quality.attrs["flag_masks"].tolist() == [int(flag) for flag in Quality]
    assert VARIABLES["reflectance"].dims == CUBE


def test_properties_that_are_no_names_stay_in_the_region() -> None:
    odd = {
        "n": 3,
        "a b": 1,
        "x/y": 2,
        "__hidden": 3,
        "nested": {"a": [1]},
        "ok": True,
        "big": 2**70,
        "band": 1,
    }
    library = extract_signatures(made(), Region("a", TWO[0].polygon, properties=odd))
    assert (library["nested"].item(), library["ok"].item()) == ('{"a": [1]}', "true")
    assert library["big"].item() == str(2**70)
    assert not {"a b", "x/y", "__hidden", "band"} & set(library.variables)
    assert library["n"].item() > 3
    assert '"x/y": 2' in library["region"].item()
    many = Region("a", TWO[0].polygon, properties={f"p{k}": k for k in range(500)})
    assert len(extract_signatures(made(), many).coords) < 80


def test_the_store_gives_back_the_same_bits(tmp_path: Path) -> None:
    library = extract_signatures(
        raw(), Regions((Region("Škoda, red", RAW[0].polygon, properties={"year": 2019}), RAW[1]))
    )
    for group in (None, "signatures"):
        path = hp.to_store(library, tmp_path / f"{group}.zarr", group)
        found = xr.open_zarr(path, group=group, consolidated=False).load()
        xr.testing.assert_equal(found, library)
        for name in library.data_vars:
            assert found[name].dtype == library[name].dtype
            assert found[name].values.tobytes() == library[name].values.tobytes(), name
        assert found.attrs.items() >= library.attrs.items()
    hp.to_store(library, tmp_path / "None.zarr")  # the same content: nothing is done


def test_units_maps_and_dims_of_others_are_taken() -> None:
    line = made()
    percent = line.assign(reflectance=(line.reflectance * np.float32(100)).assign_attrs(units="percent"))
    a, b = (extract_signatures(each, TWO).reflectance for each in (line, percent))
    np.testing.assert_allclose(a, b, rtol=1e-5)
    grid = (
        line[["reflectance", "wavelength"]]
        .rename(along_track="y", cross_track="x")
        .transpose("y", "x", "band")
    )
    grid = grid.assign_coords(x=100.0 + np.arange(16), y=500.0 - np.arange(40))
    region = Region("a", [(103, 480), (110, 480), (110, 490), (103, 490)])
    placed = extract_signatures(grid, Regions((region,), "map", "EPSG:32618"))
    drawn = extract_signatures(line.drop_vars("quality"), Region("a", [(3, 10), (10, 10), (10, 20), (3, 20)]))
    np.testing.assert_array_equal(placed.reflectance, drawn.reflectance)
    line = made().rename(along_track="downtrack", cross_track="crosstrack", band="bands")
    assert_same_bits(line.paint.signatures(TWO, members=9), extract_signatures(made(), TWO, members=9))
    odd = made().rename(along_track="flown")
    assert odd.paint.signatures(TWO, dims={"along_track": "flown"}).sizes["signature"] == 2


def test_smile_is_taken_out_before_pixels_are_put_together() -> None:
    # a steep edge, seen by every column at wavelengths of its own
    line = made(bands=40)
    nominal = line.wavelength.values
    shift = np.linspace(-6.0, 6.0, 16)
    edge = 0.1 + 0.6 / (1 + np.exp(-(nominal[:, None] + shift - 650.0) / 12.0))
    line["reflectance"] = (CUBE, np.broadcast_to(edge.astype("f4"), (40, 40, 16)).copy(), {"units": "1"})
    smiling = line.assign_coords(wavelength_shift=("cross_track", shift, {"units": "nm"}))
    expected = 0.1 + 0.6 / (1 + np.exp(-(nominal - 650.0) / 12.0))
    region = Region("a", [(0, 0), (15, 0), (15, 39), (0, 39)])
    found = extract_signatures(smiling, region).isel(signature=0)
    inner = slice(1, -1)
    np.testing.assert_allclose(found.reflectance[inner], expected[inner], atol=2e-3)
    assert found.reflectance_sd[inner].max() < 2e-3
    assert extract_signatures(line, region).reflectance_sd.max() > 0.03
    assert found.attrs["spectral_axis"] == "nominal wavelengths"


# --- regions drawn by hand ---------------------------------------------------------------------------------


def drawn(**properties: Any) -> Regions:
    return Regions((Region("hand", [(1, 1), (1, 9), (6, 9), (6, 1)], properties=properties),))


def test_the_light_of_flakes_is_no_glint() -> None:
    # Glint on a third of the pixels, in which flakes shine: only paint with flakes keeps them
    line = made()
    bright = np.zeros((line.sizes["along_track"], line.sizes["cross_track"]), np.uint16)
    bright[:4] = Quality.GLINT
    bright[5, 3] = Quality.SHADOW
    line["quality"] = (("along_track", "cross_track"), bright)
    counts = {
        finish: int(extract_signatures(line, drawn(finish=finish)).n_excluded[0])
        for finish in ("solid", "unknown", "metallic", "pearl")
    }
    assert counts["metallic"] == counts["pearl"] == 1
    assert counts["solid"] == counts["unknown"] > 10
    given = extract_signatures(line, drawn(finish="metallic"), exclude=Quality.GLINT)
    assert int(given.n_excluded[0]) > 10


def test_matt_paint_mirrors_no_sky_and_unknown_finishes_are_told() -> None:
    line = raw()
    sky: dict[str, Any] = {"specular_sky": True, "diffuse": "model", "sun_zenith": 40.0}
    seen, matt, solid = (
        extract_signatures(line, drawn(finish=finish), **options).reflectance.values
        for finish, options in (("solid", {}), ("matt", sky), ("solid", sky))
    )
    np.testing.assert_array_equal(matt, seen)
    assert np.nanmax(np.abs(solid - seen)) > 0.0
    for unknown in ("metallic flake", 3):
        with pytest.warns(PaintWarning, match="finish-unknown"):
            extract_signatures(line, drawn(finish=unknown))


def test_a_drawn_region_has_the_lean_of_its_part() -> None:
    line = raw()
    stated = {
        name: line.paint.signatures(drawn(**properties), specular_sky=True, diffuse="model")
        for name, properties in {
            "roof": {"kind": "roof", "finish": "solid"},
            "part": {"finish": "solid"},
            "flakes": {"kind": "roof", "finish": "metallic"},
            "piece": {"kind": "roof part", "finish": "metallic"},
            "ground": {"kind": "asphalt"},
            "proposed": {
                "kind": "roof",
                "lean": 0.4,
                "level_uncertainty": 0.011,
                "level_terms": {"dust": 0.011},
            },
        }.items()
    }
    level = {name: float(library.level_uncertainty[0]) for name, library in stated.items()}
    leans = {name: float(library.lean[0]) for name, library in stated.items()}
    assert leans["roof"] == pytest.approx(np.hypot(0.5, 0.8))
    assert leans["part"] == 7.0
    assert (leans["proposed"], level["proposed"]) == (0.4, 0.011)
    assert json.loads(stated["proposed"].level_terms.values[0]) == {"dust": 0.011}
    assert np.isnan([level["ground"], leans["ground"]]).all()
    # the change with lean is measured over whole roofs, and assumed of flakes on a piece of one
    assert level["roof"] < min(level["piece"], level["part"])
    assert level["flakes"] == pytest.approx(level["roof"], rel=0.1)
    # a lean of 7 degrees towards the sun, by the cosine law
    sun, split = (
        np.radians(float(stated["part"].sun_zenith[0])),
        float(stated["part"].diffuse_fraction.mean()),
    )
    assert level["part"] > np.radians(7.0) * (1.0 - split) * np.tan(sun)
    assert "lean of 7.0 degrees" in stated["part"].level_terms.values[0]
    words = {name: str(library.quantity.values[0]) for name, library in stated.items()}
    assert words["roof"] == "body reflectance factor under the clear coat"
    assert words["flakes"] == "reflectance factor at this geometry"
    assert words["proposed"] == "reflectance factor at this geometry, over coat_transmission"
    # the mirrored sky of a part that may lean is less certain, and that of flakes is not forgotten
    parts = [float(stated[name].reflectance_u_coat.mean()) for name in ("roof", "part", "flakes")]
    assert parts[1] > parts[0] > 0.0
    assert parts[2] > 0.0


def test_broken_clouds_are_not_passed_over() -> None:
    line = made()
    lines = line.sizes["along_track"]
    split = np.full((lines, line.sizes["band"]), 0.4, np.float32)
    line = line.assign(
        diffuse_fraction=(("along_track", "band"), split),
        diffuse_fraction_u=(("along_track", "band"), np.full_like(split, 0.3)),
        sky_state=("along_track", np.full(lines, SKY_STATES.index("broken"), np.int8)),
    )
    with pytest.warns(PaintWarning, match="clouds-broken"):
        library = extract_signatures(line, drawn(kind="roof"))
    assert float(library.level_uncertainty[0]) > 0.4
    # a proposed region was judged by its light
    assert float(extract_signatures(line, drawn(level_uncertainty=0.02)).level_uncertainty[0]) == 0.02


def test_the_crown_of_a_drawn_roof_tells_its_change_with_lean() -> None:
    # a lobe over a roof of 20 x 60 pixels that is turned in the picture: known slope and curvature across it
    rng = np.random.default_rng(2)
    v, u = rng.uniform(-10, 10, 256), rng.uniform(-30, 30, 256)
    slope, curvature = 0.1, -0.2
    level = 0.2 * np.exp(slope * v / 10 + curvature * (v / 10) ** 2 + rng.normal(0.0, 0.005, 256))
    turn = np.radians(30.0)
    paint = xr.Dataset(
        {
            "member_reflectance": (("member", "band"), np.tile(level[:, None], (1, 3)).astype(np.float32)),
            "member_along_track": ("member", 100.0 + u * np.cos(turn) - v * np.sin(turn)),
            "member_cross_track": ("member", 200.0 + u * np.sin(turn) + v * np.cos(turn)),
        }
    )
    error, change = change_over_crown(paint, np.ones(3, bool))
    assert change == pytest.approx(slope / np.radians(12.0), rel=0.1)
    # mean of the curved surface below its middle, and the level part not quite in the middle
    assert error == pytest.approx(np.hypot(curvature / 3.0, 0.15 * slope), rel=0.1)
    # few or no members, and gaps in every band, tell nothing; one band with gaps is left out
    assert change_over_crown(paint.isel(member=slice(20)), np.ones(3, bool)) is None
    assert change_over_crown(paint.isel(member=slice(0)), np.ones(3, bool)) is None
    gaps = np.arange(256) % 3 == np.arange(3)[:, None]
    gapped = paint.assign(
        member_reflectance=paint.member_reflectance.where(~xr.DataArray(gaps.T, dims=("member", "band")))
    )
    assert change_over_crown(gapped, np.ones(3, bool)) is None
    one_gapped = paint.assign(
        member_reflectance=gapped.member_reflectance.where(gapped.band == 0, paint.member_reflectance)
    )
    assert change_over_crown(one_gapped, np.ones(3, bool)) == pytest.approx((error, change), rel=1e-6)


# --- Thresholds of signatures: inputs on both sides of each, so that twice or half of it changes a result


Floats = npt.NDArray[np.float64]
NM = np.linspace(420.0, 980.0, 60)
ZIGZAG = np.resize([1.0, -1.0], 60)
EVERY = np.ones(60, bool)

# --- members: centre, flop, crown --------------------------------------------------------------------------


@pytest.mark.parametrize(("sd", "is_trimmed"), [(2.8, False), (3.3, True)])
def test_trimmed_mean__leaves_out_values_beyond_three_standard_deviations(
    sd: float, is_trimmed: bool
) -> None:
    # Quantiles of a normal distribution within two standard deviations, and one other value
    normal = np.sort(np.random.default_rng(8).normal(size=4001))
    normal = np.concatenate([values := normal[np.abs(normal) < 2.0], -values])
    centre = summarise(np.append(normal, sd)[:, None], "trimmed_mean")["reflectance"][0]
    assert (abs(centre) < 1e-9) == is_trimmed


def test_flop__is_of_the_means_of_the_outer_fifths_of_twenty_members() -> None:
    # Levels from 0.7 to 1.3 in equal steps: the means of the outer fifths are 0.76 and 1.24
    flops = [
        flop_of(np.linspace(0.7, 1.3, count)[:, None] * np.ones(60), EVERY)[1] for count in (1001, 22, 18)
    ]
    assert flops[0] == pytest.approx(0.48, rel=0.01)
    assert np.isfinite(flops).tolist() == [True, True, False]


@pytest.mark.parametrize(("error", "is_turned"), [(0.09, True), (0.11, False)])
def test_members_of_flakes__are_brought_to_one_angle_where_they_fit(error: float, is_turned: bool) -> None:
    # Most differ by the error from flakes whose brightness changes with the lean
    lean = np.linspace(-0.5, 0.5, 400)
    body, lobe = np.full(60, 0.2), 1.6 + 0.3 * np.cos(NM / 70.0)
    sign = np.resize([1.0, -1.0, -1.0, 1.0], 400)[:, None] * ZIGZAG
    members = body * np.exp(lean[:, None] * lobe) * (1.0 + error * sign)
    library = xr.Dataset(
        {
            "member_reflectance": (("signature", "member", "band"), members[None]),
            "reflectance": (("signature", "band"), body[None]),
            "diffuse_fraction": (("signature", "band"), diffuse_fraction(NM, 45.0)[None]),
            **{
                name: ("signature", [angle])
                for name, angle in (("sun_zenith", 45.0), ("view_zenith", 0.0), ("relative_azimuth", 0.0))
            },
        },
        {"good": ("band", EVERY)},
    )
    turned = with_aspecular_geometry(library).member_reflectance.values[0]
    assert (np.ptp(turned.mean(axis=1)) < 0.05) == is_turned


def roof(shape: tuple[int, int], slope: float = 0.0, dead: float = 0.0) -> xr.Dataset:
    # A roof whose brightness changes by a slope over half its width; a share of its members lacks a band
    y, x = (axis.ravel() for axis in np.indices(shape))
    half = (shape[0] - 1) / 2.0
    members = 0.3 * np.exp(slope * (y - half) / half)[:, None] * np.ones(60)
    members[: round(dead * len(y)), 7] = np.nan
    return xr.Dataset(
        {
            "member_reflectance": (("member", "band"), members),
            "member_along_track": ("member", y),
            "member_cross_track": ("member", x),
        }
    )


@pytest.mark.parametrize(
    ("paint", "is_known"),
    [
        (roof((20, 27)), True),  # a roof is longer than wide
        (roof((20, 22)), False),
        (roof((5, 8), dead=0.05), True),  # 38 of 40 members, of which 25 are needed
        (roof((5, 8), dead=0.5), True),  # a band that many lack is not used
    ],
)
def test_crown__is_known_of_members_along_a_roof(paint: xr.Dataset, is_known: bool) -> None:
    assert (change_over_crown(paint, EVERY) is not None) == is_known


def test_crown__is_level_near_its_middle() -> None:
    # Within a seventh of half its width: drawn roofs are off by some pixels of thirty
    u, _ = change_over_crown(roof((30, 60), slope=0.3), EVERY) or (0.0, 0.0)
    assert 0.1 < u / 0.3 < 0.22


# --- uncertainty of the level ------------------------------------------------------------------------------


def terms_of(state: str, fraction_u: float) -> Any:
    # Terms of the level of a panel whose brightness is 0.3, between 0.27 and 0.33
    lines, nm = 24, NM[::5]
    cube = np.broadcast_to(np.linspace(0.27, 0.33, 20), (lines, nm.size, 20)).astype(np.float32)
    size = lines, nm.size
    line = xr.Dataset(
        {
            "reflectance": (("along_track", "band", "cross_track"), cube, {"units": "1"}),
            "diffuse_fraction": (("along_track", "band"), np.full(size, 0.2), {"units": "1"}),
            "diffuse_fraction_u": (("along_track", "band"), np.full(size, fraction_u), {"units": "1"}),
            "sky_state": ("along_track", np.full(lines, SKY_STATES.index(state), np.int8)),
        },
        {"wavelength": ("band", nm, {"units": "nm"})},
    )
    corners = [(0, 0), (19, 0), (19, lines - 1), (0, lines - 1)]
    regions = hp.Regions((hp.Region("hood", corners, properties={"finish": "solid"}),))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PaintWarning)
        return json.loads(hp.extract_signatures(line, regions, sun_zenith=None).level_terms.item())


@pytest.mark.parametrize(("fraction_u", "least", "most"), [(0.11, 0.0, 0.1), (0.13, 0.4, 0.7)])
def test_broken_clouds__leave_the_sun_free_or_cover_it(fraction_u: float, least: float, most: float) -> None:
    # A covered sun takes half of the light and more
    assert least < terms_of("broken", fraction_u)["broken clouds"] < most


def test_level__lies_anywhere_between_the_quartiles() -> None:
    # Expected: the standard deviation of a uniform distribution over half of the change
    (part,) = (value for name, value in terms_of("clear", 0.02).items() if name.startswith("its change over"))
    assert part == pytest.approx(np.std(np.linspace(-0.05, 0.05, 10_001)), rel=0.02)


# --- strength of a coat ------------------------------------------------------------------------------------


def components(*parts: tuple[Floats, float], count: int = 200) -> Floats:
    # Members of a dark body whose differences are some spectra, with shares of their variance
    scores = np.linalg.qr(np.random.default_rng(5).normal(size=(count, len(parts))))[0]
    scores -= scores.mean(axis=0)
    scores = np.linalg.qr(scores)[0]
    sizes = [np.sqrt(share) * spectrum / np.linalg.norm(spectrum) for spectrum, share in parts if share > 0.0]
    return np.asarray(np.full(60, 0.02) + 0.02 * scores[:, : len(sizes)] @ np.stack(sizes))


def leaning(sun: float) -> Floats:
    # Change of a dark body's spectrum with lean
    split = diffuse_fraction(NM, sun)
    return np.asarray(1.0 - split + sunward_gain(NM, sun) * split)


@pytest.mark.parametrize(
    ("sun", "count", "share", "unexplained", "words"),
    [
        (45.0, 42, 1.0, 0.0, ""),
        (45.0, 38, 1.0, 0.0, "38 pixels"),
        (27.0, 200, 1.0, 0.0, ""),
        (23.0, 200, 1.0, 0.0, "the sun at 23"),
        (68.0, 200, 1.0, 0.0, ""),
        (72.0, 200, 1.0, 0.0, "the sun at 72"),
        (45.0, 200, 0.53, 0.0, ""),
        (45.0, 200, 0.47, 0.0, "the first principal component"),
        (45.0, 200, 1.0, 0.045, ""),
        (45.0, 200, 1.0, 0.055, "neither lean nor mirrored sky"),
    ],
)
def test_strength_of_a_coat__is_measured_where_lean_and_sky_explain_the_pixels(
    sun: float, count: int, share: float, unexplained: float, words: str
) -> None:
    smooth = leaning(sun) / np.linalg.norm(leaning(sun))
    rough = ZIGZAG / np.sqrt(60.0)
    first = np.sqrt(1.0 - unexplained) * smooth + np.sqrt(unexplained) * rough
    rest = [np.roll(np.resize([1.0, 1.0, -1.0, -1.0], 60), k) * np.sin(NM / 40.0 + k) for k in range(2)]
    members = components((first, share), *((part, (1.0 - share) / 2.0) for part in rest), count=count)
    reason = strength_of(members, NM, diffuse_fraction(NM, sun), sun)[2]
    refusals = ("pixels, expected", "the sun at", "principal component", "neither lean")
    assert words in reason
    assert any(text in reason for text in refusals) == bool(words)


# --- From where a signature is seen: against cameras turned by rotation matrices, and against traced rays


ANGLES = ("view_zenith", "view_azimuth", "relative_azimuth")


def with_camera(line: xr.Dataset, *, turned: float = 8.0, heading: float = 100.0) -> xr.Dataset:
    # Return a line with look angles and an attitude that changes from line to line
    rng = np.random.default_rng(1)
    lines, columns = line.sizes["along_track"], line.sizes["cross_track"]
    angles = {
        "roll": turned * rng.standard_normal(lines),
        "pitch": turned * rng.standard_normal(lines),
        "heading": heading + turned * rng.standard_normal(lines),
    }
    line = line.assign_coords({k: ("along_track", v, {"units": "degree"}) for k, v in angles.items()})
    return line.assign(look_angle=("cross_track", np.linspace(-12.0, 20.0, columns), {"units": "degree"}))


def to_camera(line: xr.Dataset, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    # Return the mean unit vector to the camera (east, north, up), by scipy's rotations
    attitude = np.stack([line[name].values[along] for name in ("heading", "pitch", "roll")], axis=1)
    look = np.radians(line["look_angle"].values[across])
    sight = np.stack([np.zeros_like(look), np.sin(look), np.cos(look)], axis=1)
    north, east, down = Rotation.from_euler("ZYX", attitude, degrees=True).apply(sight).T
    mean: np.ndarray = -np.stack([east, north, -down], axis=1).mean(axis=0)
    return mean


def test_the_attitude_of_the_camera() -> None:
    line = with_camera(made())
    library = extract_signatures(line, TWO, exclude=0)
    for region, paint in zip(TWO, library["signature"].values, strict=True):
        along, across = hp.regions.pixels(region, line)
        present = np.isfinite(line.reflectance.values[along, :, across]).any(axis=1)
        east, north, up = to_camera(line, along[present], across[present])
        found = library.sel(signature=paint)
        assert float(found.view_zenith) == pytest.approx(np.degrees(np.arctan2(np.hypot(east, north), up)))
        assert float(found.view_azimuth) == pytest.approx(np.degrees(np.arctan2(east, north)) % 360)
    assert library.attrs["view_geometry"].startswith("look_angle with roll, pitch, heading")
    # of a level camera
    line = with_camera(made(), turned=0.0, heading=0.0)
    line["look_angle"] = ("cross_track", np.full(16, 10.0), {"units": "degree"})
    library = extract_signatures(line, TWO)
    # what is seen to the right of a flight north lies in the east; the camera is then in the west
    np.testing.assert_allclose(library.view_zenith, 10.0)
    np.testing.assert_allclose(library.view_azimuth, 270.0)
    radians = line.assign(look_angle=("cross_track", np.radians(np.full(16, 10.0)), {"units": "radian"}))
    np.testing.assert_allclose(extract_signatures(radians, TWO).view_zenith, 10.0)
    line = with_camera(made(), turned=0.0)
    line["look_angle"] = ("cross_track", np.linspace(-15.0, 15.0, 16), {"units": "degree"})
    library = extract_signatures(line, Region("whole", [(0, 0), (15, 0), (15, 39), (0, 39)]), exclude=0)
    assert float(library.view_zenith[0]) < 0.5


@pytest.mark.parametrize("chunks", [None, {"along_track": 7}, {"along_track": 16, "cross_track": 4}])
def test_directions_of_the_pixels_come_first(chunks: Any) -> None:
    line = with_camera(made())
    zenith = np.full((40, 16), 30.0, np.float32)
    zenith[line.quality.values > 0] = 80.0  # of pixels that are left out
    dims, attrs = ("along_track", "cross_track"), {"units": "degree"}
    azimuth = np.full((40, 16), 350.0, np.float32)
    line = line.assign(view_zenith=(dims, zenith, attrs), view_azimuth=(dims, azimuth, attrs))
    every = int(np.bitwise_or.reduce(line.quality.values, axis=None))
    library = extract_signatures(line if chunks is None else line.chunk(chunks), TWO, exclude=every)
    np.testing.assert_allclose(library.view_zenith, 30.0, rtol=1e-6)
    np.testing.assert_allclose(library.view_azimuth, 350.0, rtol=1e-6)
    assert library.attrs["view_geometry"] == "view_zenith and view_azimuth of the pixels"
    without = extract_signatures(line.drop_vars("view_azimuth"), TWO, exclude=every)
    np.testing.assert_allclose(without.view_zenith, 30.0, rtol=1e-6)
    assert np.isnan(without.view_azimuth).all()
    assert np.isnan(without.relative_azimuth).all()


def test_what_is_not_known_is_said() -> None:
    plain = extract_signatures(made(), TWO)
    for name in ANGLES:
        assert np.isnan(plain[name]).all()
    assert plain.attrs["view_geometry"] == (
        "unknown: no view_zenith of the pixels, and no look_angle, roll, pitch"
    )
    camera = with_camera(made())
    assert "and no roll" in extract_signatures(camera.drop_vars("roll"), TWO).attrs["view_geometry"]
    camera["pitch"].attrs = {}
    found = extract_signatures(camera, TWO)
    assert np.isnan(found.view_zenith).all()
    assert "'pitch' has no units" in found.attrs["view_geometry"]
    without = extract_signatures(with_camera(made()).drop_vars("heading"), TWO)
    assert np.isfinite(without.view_zenith).all()
    assert np.isnan(without.view_azimuth).all()
    lost = with_camera(made())
    lost["roll"] = lost["roll"].where(False).assign_attrs(units="degree")
    assert np.isnan(extract_signatures(lost, TWO).view_zenith).all()
    grid = posed({"heading_reference": "grid"})
    library, plain = (
        extract_signatures(one, TWO, exclude=0) for one in (grid, posed({}).drop_vars("heading"))
    )
    # without azimuths both are plain means
    np.testing.assert_allclose(library.view_zenith, plain.view_zenith)
    assert np.isnan(library.view_azimuth).all()
    nonsense = posed({}).assign_attrs(convention_roll_positive="sideways")
    assert "sideways" in extract_signatures(nonsense, TWO, exclude=0).attrs["view_geometry"]


def test_sun_and_camera() -> None:
    line = raw()
    with dask.config.set(scheduler="synchronous"):
        library = extract_signatures(line, RAW)
    at = line.time.values[20], float(line.latitude[20]), float(line.longitude[20])
    azimuth = float(solar_position(*at)[1])
    apart = np.abs((library.view_azimuth.values - azimuth + 180) % 360 - 180)
    np.testing.assert_allclose(library.relative_azimuth, apart, atol=0.05)
    assert ((library.relative_azimuth >= 0) & (library.relative_azimuth <= 180)).all()
    assert (library.view_zenith < 2.0).all()
    for name, standard in (
        ("sun_zenith", "solar_zenith_angle"),
        ("sun_azimuth", "solar_azimuth_angle"),
        ("view_zenith", "sensor_zenith_angle"),
        ("view_azimuth", "sensor_azimuth_angle"),
    ):
        assert library[name].attrs["standard_name"] == standard
        assert library[name].attrs["units"] == LIBRARY_VARIABLES[name].units == "degree"
    assert_same_bits(library, extract_signatures(line.chunk(along_track=7), RAW))


@pytest.mark.slow
def test_look_angles_come_with_the_calibration(tmp_path: Path) -> None:
    collect = hp.simulate_collect(
        tmp_path / "raw", lines=32, bands=12, columns=16, scene="plan", truth=False, cubes=1
    )
    line = hp.open_store(hp.process(collect, tmp_path / "lot.zarr"), "flightlines/raw_0")
    assert line.look_angle.dtype == VARIABLES["look_angle"].dtype
    # 7.4 um at 12 mm
    np.testing.assert_allclose(np.tan(np.radians(line.look_angle)), (np.arange(16) - 7.5) * 7.4e-6 / 12e-3)
    library = extract_signatures(line, Region("right", [(12, 2), (15, 2), (15, 20), (12, 20)]), exclude=0)
    assert np.isfinite(library.view_zenith).all()


@pytest.mark.slow
def test_traced_rays_come_from_there() -> None:
    from hyperpaint.simulation.rendering.platforms import pushbroom
    from hyperpaint.simulation.rendering.scene import plane
    from hyperpaint.workflows.rendering import look_angle_of, pose_of

    flight = pushbroom(16, 24, altitude=20.0, ground_sample=0.6, line_spacing=0.3, heading=30.0, wobble=5.0)
    traced = hp.simulation.trace(plane(200.0), flight, ["noon"], samples=64).compute()
    cube = (("along_track", "band", "cross_track"), np.full((16, 2, 24), 0.3, "f4"), {"units": "1"})
    line = xr.Dataset(
        {"reflectance": cube, "look_angle": look_angle_of(flight)},
        {"wavelength": ("band", [500.0, 600.0], {"units": "nm"}), **pose_of(flight)},
    )
    region = Region("left", [(1, 4), (3, 4), (3, 6), (1, 6)])
    library = extract_signatures(line, region, exclude=0)
    along, across = hp.regions.pixels(region, line)
    camera = flight.origin.mean(axis=1)[along]
    seen = np.stack([traced[name].values[along, across] for name in ("east", "north", "up")], axis=1)
    away = camera - seen
    east, north, up = (away / np.linalg.norm(away, axis=1, keepdims=True)).mean(axis=0)
    zenith, azimuth = np.degrees([np.arctan2(np.hypot(east, north), up), np.arctan2(east, north)])
    # the middle of 64 rays through a pixel of 1.7 degrees
    assert float(library.view_zenith[0]) == pytest.approx(zenith, abs=0.1)
    assert float(library.view_azimuth[0]) == pytest.approx(azimuth % 360, abs=0.5)


CONVENTIONS = {
    "canonical": {},
    "roll": {"roll_positive": "right_wing_up"},
    "pitch": {"pitch_positive": "nose_down"},
    "heading": {"heading_positive": "counterclockwise"},
    "order": {"euler_order": "ZXY"},
    "all": {"roll_positive": "right_wing_up", "pitch_positive": "nose_down", "euler_order": "XYZ"},
    "magnetic": {"heading_reference": "magnetic", "declination": -6.5},
    "grid": {"heading_reference": "grid", "grid_crs": "EPSG:32616"},
}


def posed(declared: dict[str, Any], *, mounted: tuple[float, ...] = (0.0, 0.0, 0.0)) -> xr.Dataset:
    # Return a line with poses, and the angles that its calibration and a table of the camera have
    line = with_camera(made(), heading=70.0)
    place = {
        "latitude": (34.0, "degrees_north"),
        "longitude": (-81.0, "degrees_east"),
        "altitude": (300.0, "m"),
    }
    line = line.assign_coords(
        {
            name: ("along_track", np.full(40, value), {"units": units})
            for name, (value, units) in place.items()
        }
    )
    convention = Convention(**declared)
    return line.assign_attrs(convention.to_attrs(), ground=0.0, boresight=list(mounted))


@pytest.mark.parametrize("mounted", [(0.0, 0.0, 0.0), (2.0, -3.0, 5.0)])
@pytest.mark.parametrize("declared", CONVENTIONS)
@pytest.mark.parametrize("table", ["look_angle", "look_along"])
def test_a_line_is_seen_from_where_its_located_self_is(
    declared: str, mounted: tuple[float, ...], table: str
) -> None:
    pytest.importorskip("pyproj")
    line = posed(CONVENTIONS[declared], mounted=mounted)
    angles: dict[str, Any] = {}
    if table != "look_angle":
        # of [geometry]: goes before what the calibration says
        angles["look_across"] = ("cross_track", np.linspace(9.0, 31.0, 16), {"units": "degree"})
    if table == "look_along":
        angles["look_along"] = ("cross_track", np.linspace(1.0, 2.0, 16), {"units": "degree"})
    line = line.assign_coords(angles)
    seen, located = (extract_signatures(one, TWO, exclude=0) for one in (line, hp.geometry.locate(line)))
    # the earth is round: over 100 m its vertical turns by a thousandth of a degree
    np.testing.assert_allclose(seen.view_zenith, located.view_zenith, atol=0.003)
    apart = np.abs((seen.view_azimuth - located.view_azimuth + 180.0) % 360.0 - 180.0)
    assert float((apart * np.sin(np.radians(located.view_zenith))).max()) < 0.003
    assert ("boresight" in seen.attrs["view_geometry"]) == any(mounted)
