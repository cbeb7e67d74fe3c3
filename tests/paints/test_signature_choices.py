"""What goes into a signature: flags, smoothing, corrections, several lines; and the library it makes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from oracles.disort_sky import relative_sky
from support.painted_lines import CHUNKINGS, RAW, SPECTRA, TWO, assert_same_bits, made, raw
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint import Quality, Region, Regions, SchemaError, extract_signatures
from hyperpaint.base.errors import PaintWarning
from hyperpaint.base.schema import CUBE, LIBRARY_VARIABLES, VARIABLES
from hyperpaint.light.diffuse_record import SKY_STATES
from hyperpaint.light.sun import diffuse_fraction
from hyperpaint.paints.signatures.extraction import change_over_crown
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
    with pytest.raises(SchemaError, match="region-too-small"):
        extract_signatures(line, TWO, exclude=flag)


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
    with pytest.raises(SchemaError) as caught:
        extract_signatures(line, TWO)
    told = str(caught.value)
    for region in TWO:
        size = pixels(region, line)[0].size
        assert f"{region.name!r}: 0 of {size} pixels are usable, expected 5 (100% shadow)" in told, told
    beyond = Regions(
        (TWO[0], Region("far", [(90, 90), (99, 90), (99, 99)]), Region("off", [(90, 0), (99, 0), (99, 9)]))
    )
    with pytest.raises(SchemaError, match=r"(?s)'far'.*40 l.*'off'"):
        extract_signatures(line, beyond)


def test_a_region_with_too_few_pixels_is_dropped_on_request(tmp_path: Path) -> None:
    line = made()
    cells = pixels(TWO[0], line)
    line["quality"].values[cells] |= int(Quality.SHADOW)
    with pytest.raises(SchemaError, match="region-too-small"):
        extract_signatures(line, TWO)
    library = extract_signatures(line, TWO, drop_small=True)
    assert library.equals(extract_signatures(line, TWO[1:]))
    (said,) = library.attrs["left_out"]
    assert f"{TWO[0].name!r}: 0 of {cells[0].size} pixels are usable" in said
    hp.write_library(library, tmp_path / "paints.zarr")
    assert hp.open_library(tmp_path / "paints.zarr").attrs["left_out"] == [said]
    line["quality"].values[:] |= int(Quality.SHADOW)
    with pytest.raises(SchemaError, match="region-too-small"):
        extract_signatures(line, TWO, drop_small=True)


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
    with pytest.raises(SchemaError, match="already-smoothed"):
        extract_signatures(line.paint.smooth("box", 3), TWO, smooth="box")
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
    with pytest.raises(SchemaError, match=r"tilt.*corrected-before"):
        extract_signatures(tilted, TWO, specular_sky=True, sun_zenith=40.0)
    with pytest.raises(SchemaError, match="corrected-before"):
        hp.surroundings.remove_mirrored_sky(library, sun_zenith=40.0)
    lit = hp.surroundings.correct_light(line, direct=0.9, sun_zenith=40.0)
    assert extract_signatures(lit, TWO).attrs["corrections"].startswith("light_corrected: direct 0.9")
    assert extract_signatures(line, TWO).attrs["corrections"] == "none"
    assert "tilt" not in line.reflectance.attrs


def test_the_same_bits_without_the_mirrored_sky() -> None:
    line = raw()
    expected = line.paint.signatures(RAW, specular_sky=True, smooth="box")
    for chunks in CHUNKINGS[1:]:
        lazy = line.assign(counts=line.counts.chunk(chunks), time=line.time.chunk(along_track=7))
        assert_same_bits(lazy.paint.signatures(RAW, specular_sky=True, smooth="box"), expected)
    assert expected.attrs["corrections"].startswith("mirrored_sky_removed: F0 0.04")


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


def test_a_mirrored_sky_that_cannot_be_subtracted() -> None:
    line = made()
    expect_refusals(
        (SchemaError, "sun-unknown", lambda: extract_signatures(line, TWO, specular_sky=True)),
        (SchemaError, "argument-missing", lambda: extract_signatures(line, TWO, sun_zenith=30.0)),
    )
    removed = hp.surroundings.remove_mirrored_sky(line.assign_coords(dict([SMILE])), sun_zenith=40.0)
    with pytest.raises(SchemaError, match="corrected-before"):
        extract_signatures(removed, TWO, specular_sky=True, sun_zenith=40.0)


def test_every_wrong_option_is_told() -> None:
    with pytest.raises(SchemaError) as caught:
        extract_signatures(
            made(), Regions(()), exclude="glint", members=-1, centre="mean", min_pixels=0  # type: ignore[arg-type]
        )  # fmt: skip
    told = str(caught.value)
    assert all(
        word in told
        for word in ("regions= is empty", "exclude='glint'", "members=-1", "centre='mean'", "min_pixels=0")
    )
    with pytest.raises(SchemaError, match="type-wrong"):
        extract_signatures(3, TWO)  # type: ignore[arg-type]
    with pytest.raises(SchemaError, match="compute reflectance"):
        extract_signatures(made().drop_vars("reflectance"), TWO)
    with pytest.raises(SchemaError, match="'wavelength' is missing"):
        extract_signatures(made().drop_vars("wavelength"), TWO)


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
    with pytest.raises(SchemaError, match=r"'raw_0'.*bands-differ"):
        extract_signatures({**lines, "raw_0": other}, regions)


def test_a_region_of_another_line_is_never_taken_for_this_one() -> None:
    with pytest.raises(SchemaError, match=r"expected 'raw_0' .flight"):
        extract_signatures(made(), on_lines("raw_7"))
    with pytest.raises(SchemaError, match=r"(?s)p0.*'a' or 'b'.*p1"):
        extract_signatures({"a": made(), "b": made()}, on_lines("", "c"))
    nameless = made()
    del nameless.attrs["name"]
    assert extract_signatures(nameless, on_lines("raw_7")).n.size == 1
    with pytest.raises(SchemaError, match=r"'p1'.*flightline-unknown"):
        extract_signatures(nameless, on_lines("raw_7", "raw_8"))


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
