"""Signatures against references: common bands, pairs, parts, tolerance, and what is said of them."""

import html.parser
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from support.agreeing_spectra import NM, agreeing, field, library, seen, smooth, value_of
from support.refusals import expect_error, expect_errors, expect_refusals, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError, UnitsError
from hyperpaint.base.mirrored_light import BODY, OUTSIDE, THROUGH_COAT
from hyperpaint.light.diffuse_record import SKY_STATES
from hyperpaint.simulation import simulate_line
from hyperpaint.simulation.rendering.materials import coated_reflectance
from hyperpaint.validation.validating import STATISTICS, join_detectors, statistics_of, uncertainty_of

FIELD_NM = np.arange(380.0, 1021.0)
LEVEL = seen(FIELD_NM, 3.0)
PAINT = seen(NM, 6.0)
INFRARED = np.arange(1100.0, 1300.0)


def panel_of(value: float) -> xr.DataArray:
    return xr.DataArray(
        [value, value],
        {"wavelength": ("wavelength", [300.0, 2500.0], {"units": "nm"})},
        "wavelength",
        attrs={"units": "1"},
    )


@pytest.fixture
def signatures() -> xr.Dataset:
    return agreeing()[0]


@pytest.fixture
def references() -> xr.Dataset:
    return agreeing()[1]


# --- common bands ------------------------------------------------------------------------------------------


def test_two_instruments_that_see_one_paint_agree() -> None:
    found = hp.validate(*agreeing())
    assert found.passed
    assert value_of(found, "rmse") < 1e-5
    # sampled at the centres of the bands, or seen twice as wide, it would not
    assert np.abs(np.interp(NM, FIELD_NM, agreeing()[1]["reflectance"].values[0]) - PAINT).max() > 2e-4
    assert found.statistics["bands"].sel(part="all").item() == NM.size
    assert found.statistics["bands"].sel(part="VIS").item() == ((NM >= 400) & (NM < 700)).sum()
    assert found.statistics["coverage"].min() > 0.999


def test_statistics_are_those_of_plain_numpy(signatures: xr.Dataset, references: xr.Dataset) -> None:
    signatures["reflectance"] = signatures["reflectance"] * 1.1 + np.float32(0.01)
    signatures["reflectance"].attrs["units"] = "1"
    found = hp.validate(signatures, references, parts={"red": (600.0, 700.0)}, tolerance=0.001)
    here = (NM >= 600) & (NM < 700)
    s, r = signatures["reflectance"].values[0, here].astype(float), PAINT[here]
    d = s - r
    expected = {
        "bias": d.mean(), "rmse": np.sqrt((d**2).mean()), "mae": np.abs(d).mean(),
        "spectral_angle": np.degrees(np.arccos((s @ r) / np.linalg.norm(s) / np.linalg.norm(r))),
        "scale": (s @ r) / (r @ r),
    }  # fmt: skip
    for name, wanted in expected.items():
        assert value_of(found, name, "red") == pytest.approx(wanted, rel=1e-3), name
    assert (found.passed, found.problems) == (False, (("hood against hood of ASD: red",)))


def test_identical_libraries_agree_wholly() -> None:
    paints = library([smooth(NM), 0.5 * smooth(NM)], ("hood", "roof"))
    found = hp.validate(paints, paints, tolerance=0.0)
    assert found.passed
    assert (found.statistics[["bias", "rmse", "mae", "spectral_angle"]].to_array() == 0).all()
    assert found.statistics["signature"].values.tolist() == ["hood", "roof"]


def test_a_coarser_reference_is_not_sharpened() -> None:
    at = np.arange(430.0, 960.0, 15.0)
    found = hp.validate(agreeing()[0], library(seen(at, 20.0), nm=at, fwhm=20.0))
    assert found.spectra[0].sizes["band"] == at.size
    assert value_of(found, "rmse") < 5e-5
    assert any("resampled to the reference's bands" in note for note in found.notes[0])


def test_bands_that_are_not_seen_whole_are_left_out_and_counted() -> None:
    nm = np.arange(500.0, 901.0)
    found = hp.validate(agreeing()[0], field(seen(nm, 3.0), nm=nm))
    spectra = found.spectra[0]
    used = spectra["used"].values
    assert NM[used].min() > 505
    assert NM[used].max() < 895
    count = found.statistics.isel(pair=0).sel(part="all")
    assert (int(count["bands"]), int(count["bands_left_out"])) == (used.sum(), (~used).sum())
    edge = spectra["coverage"].values[(NM > 498) & (NM < 502)]
    # of a Gaussian of 6 nm by hand: from its end on
    np.testing.assert_allclose(
        edge,
        [
            0.5 * (1 + math.erf((c - 500.0) / (6.0 / 2.3548) / np.sqrt(2)))
            for c in NM[(NM > 498) & (NM < 502)]
        ],
        atol=0.03,
    )
    assert np.isnan(spectra["reference"].values[~used]).all()


def test_missing_samples_cost_their_bands_only(signatures: xr.Dataset, references: xr.Dataset) -> None:
    references["reflectance"][0, 200:215] = np.nan  # 580 to 594 nm
    signatures["reflectance"][0, 3] = np.nan
    signatures = signatures.assign_coords(good=("band", np.arange(NM.size) != 50))
    found = hp.validate(signatures, references)
    left = NM[~found.spectra[0]["used"].values]
    assert set(left) >= {NM[3], NM[50], *NM[(NM > 580) & (NM < 594)]}
    assert left.size < 10
    assert value_of(found, "rmse") < 1e-5
    # a single one is bridged: its neighbours see the same
    one = agreeing()[1]
    one["reflectance"][0, 200] = np.nan
    assert hp.validate(agreeing()[0], one).spectra[0]["used"].all()


def test_detectors_that_overlap_serve_to_the_middle() -> None:
    vnir, swir = np.arange(380.0, 1000.5, 1.5), np.arange(940.0, 1200.0, 3.7)
    nm = np.concatenate([vnir, swir])
    values = np.concatenate([seen(vnir, 3.5), seen(swir, 9.5) + 0.3])  # a step that must not leak
    found = hp.validate(agreeing()[0], field(values, nm=nm, fwhm=None, instrument="SVC"))
    used = found.spectra[0]["used"].values
    difference = np.abs(found.spectra[0]["difference"].values)
    join = 0.5 * (vnir[-1] + 940.0)
    assert difference[used & (join - 15.0 > NM)].max() < 1e-4
    assert any("detectors joined at 969.8 nm" in note for note in found.notes[0])
    assert not used[join + 12.0 < NM].any()  # channels of 9.5 nm cannot tell what 6 nm see
    assert any("narrower than" in note for note in found.notes[0])


@pytest.mark.parametrize(
    "wavelength", [[], [1.0, np.nan], [5.0, 1.0] * 20, [1.0, 2.0, 9.0, 3.0, 2.5, 2.6, 2.7]]
)
def test_wavelengths_in_no_order(wavelength: list[float]) -> None:
    expect_error(SchemaError, None, lambda: join_detectors(np.array(wavelength)))


def test_a_file_may_descend(signatures: xr.Dataset, references: xr.Dataset) -> None:
    turned = references.isel(wavelength=slice(None, None, -1))
    backwards = signatures.isel(band=slice(None, None, -1))
    one, other = hp.validate(signatures, references), hp.validate(backwards, turned)
    assert value_of(one, "rmse") == pytest.approx(value_of(other, "rmse"), abs=1e-12)


def test_units_are_converted_and_wanted(signatures: xr.Dataset, references: xr.Dataset) -> None:
    percent = references.assign(reflectance=(100 * references["reflectance"]).assign_attrs(units="percent"))
    percent = percent.assign_coords(
        wavelength=("wavelength", percent.wavelength.values / 1e3, {"units": "um"})
    )
    assert value_of(hp.validate(signatures, percent, reference_fwhm=3.0), "rmse") < 1e-5
    bare = references.assign(reflectance=references["reflectance"].assign_attrs(units="sr-1"))
    expect_errors((SchemaError, r"reference 1:.*'sr-1'", lambda: hp.validate(signatures, bare)))
    del references["reflectance"].attrs["units"]
    signatures["reflectance"].attrs["units"] = "furlong"
    expect_errors(
        (SchemaError, "units-missing", lambda: hp.validate(agreeing()[0], references)),
        ((SchemaError, UnitsError), "furlong", lambda: hp.validate(signatures, agreeing()[1])),
    )


# --- wavelengths that are wrong ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_shift_of_wavelength_shows_in_the_oxygen_residual() -> None:
    line = simulate_line(lines=8, columns=3, smile_nm=0.0, noise=False)
    region = hp.Regions((hp.Region("hood", [(0, 0), (2, 0), (2, 7), (0, 7)]),))
    flat = field(np.full(FIELD_NM.size, 0.3))
    depths = []
    for shift in (0.0, 0.5):
        moved = line.assign_coords(wavelength=line.wavelength + shift)
        found = hp.validate(hp.extract_signatures(moved, region), flat, tolerance=1.0)
        depths.append(found.statistics["oxygen_residual"].item())
        assert found.statistics["reference_oxygen_residual"].item() == pytest.approx(0.0, abs=1e-9)
        assert depths[-1] == pytest.approx(float(hp.alignment.oxygen_residual(moved).mean()), abs=2e-3)
    assert abs(depths[0]) < 2e-3
    assert depths[1] < -0.02


# --- uncertainty -------------------------------------------------------------------------------------------


def test_uncertainties_of_the_library_are_propagated() -> None:
    found = hp.validate(
        library(PAINT, reflectance_u_random=np.full(NM.size, 0.003), reflectance_u_systematic=0.04 * PAINT),
        field(LEVEL),
    )
    expected = np.hypot(0.003 / np.sqrt(NM.size), 0.04 * PAINT.mean())
    assert value_of(found, "bias_u") == pytest.approx(expected, rel=0.08)
    assert value_of(found, "scale_u") == pytest.approx(0.04, rel=0.08)
    assert value_of(found, "spectral_angle_u") < np.degrees(0.02)  # what is common to all bands has no shape
    np.testing.assert_allclose(found.spectra[0]["signature_u"], np.hypot(0.003, 0.04 * PAINT), rtol=0.15)
    assert any("of the reference is unknown" in note for note in found.notes[0])


def test_repeated_readings_tell_their_own_uncertainty() -> None:
    levels, names = np.array([0.97, 1.0, 1.04, 1.01]), [f"hood_{n}" for n in range(4)]
    found = hp.validate(agreeing()[0], field(np.outer(levels, LEVEL), names), {"hood": names})
    assert found.statistics.sizes["pair"] == 1
    assert value_of(found, "scale") == pytest.approx(1 / levels.mean(), rel=1e-3)
    assert value_of(found, "scale_u") == pytest.approx(levels.std(ddof=1) / 2, rel=0.1)
    np.testing.assert_allclose(found.spectra[0]["reference_sd"], levels.std(ddof=1) * PAINT, rtol=1e-3)


def test_nothing_known_is_said_so() -> None:
    found = hp.validate(*agreeing())
    assert np.isnan(found.statistics["rmse_u"]).all()
    assert any("signature and the reference is unknown" in note for note in found.notes[0])
    assert "signature_u" not in found.spectra[0]


def test_a_standard_deviation_stands_for_an_unknown_uncertainty(
    signatures: xr.Dataset, references: xr.Dataset
) -> None:
    sd = ("spectrum", "wavelength"), 0.1 * references["reflectance"].values, {"units": "1"}
    counted = references.assign(reflectance_sd=sd, n=("spectrum", [25]))
    assert (
        value_of(hp.validate(signatures, references.assign(reflectance_sd=sd)), "scale_u"),
        value_of(hp.validate(signatures, counted), "scale_u"),
    ) == (pytest.approx(0.1, rel=0.15), pytest.approx(0.02, rel=0.1))


def test_order_of_paints_changes_nothing() -> None:
    values = np.stack([PAINT, 0.5 * PAINT])
    paints = library(values, ("hood", "roof"), reflectance_u_random=np.full(values.shape, 0.01))
    references = field(np.stack([smooth(FIELD_NM)] * 2), ("hood", "roof"))
    one = hp.validate(paints, references).statistics.set_index(pair="signature")
    assert one["rmse_u"].equals(
        hp.validate(paints.isel(signature=[1, 0]), references)
        .statistics.set_index(pair="signature")["rmse_u"]
        .sel(pair=one["pair"])
    )


# --- pairs -------------------------------------------------------------------------------------------------


def test_pairs_by_property_else_by_name_never_by_likeness() -> None:
    paints = library([smooth(NM)] * 4, ("hood", "roof", "door", "bonnet")).assign_coords(
        reference=("signature", np.array(["red_01", "", "nowhere", ""], object))
    )
    found = hp.validate(
        paints,
        field([smooth(FIELD_NM)] * 4, ["svc/red_01.sig", "roof.asd.txt", "hood", "other"]),
    )
    pairs = list(zip(found.statistics["signature"].values, found.statistics.reference.values, strict=True))
    assert pairs == [("hood", "svc/red_01.sig"), ("roof", "roof.asd.txt")]
    assert found.unpaired_signatures == ("door (no reference 'nowhere')", "bonnet")
    assert found.unpaired_references == ("hood (ASD)", "other (ASD)")
    expect_words(found.table(), "without a reference: door", "references without a paint: hood")


def test_names_that_a_reader_numbered_pair_only_where_they_are_named() -> None:
    paints = library([smooth(NM), 0.5 * smooth(NM)], ("column 3", "roof"))
    assert hp.validate(paints, paints).unpaired_signatures == ("column 3 (numbered by its reader)",)
    named = hp.validate(paints, paints, pairs={"column 3": "column 3"})
    assert named.statistics["signature"].values.tolist() == ["column 3"]


def test_pairs_by_place_where_no_name_matches() -> None:
    # from the first paint: metres north [1e-5 degree = 1.1 m]
    def placed(data: xr.Dataset, dim: str, *north: float) -> xr.Dataset:
        at = np.array(north) * 1e-5
        return data.assign_coords(latitude=(dim, 43.0 + at), longitude=(dim, 0.0 * at - 77.0))

    paints = placed(
        library([smooth(NM)] * 4, ("red-01", "red-02", "hood", "roof")), "signature", 0, 20, 40, 60
    )
    spectra = [smooth(FIELD_NM)] * 6
    # beside the first; between the next two; far away; named, and at a tie; without a fix; named, elsewhere
    names = ["a", "b", "c", "hood", "d", "roof"]
    references = placed(field(spectra, names), "spectrum", 2, 29, 500, 38, np.nan, 0.5)
    found = hp.validate(paints, references.isel(spectrum=slice(0, 5)))
    pairs = list(zip(found.statistics["signature"].values, found.statistics.reference.values, strict=True))
    assert pairs == [("red-01", "a"), ("hood", "hood")]
    assert "signature: matched by place: a is 2.2 m from red-01, 20.0 m from the next paint" in found.notes[0]
    assert found.unpaired_references == (
        "b (ASD: 10.0 m from the nearest paint red-02, beyond 5 m)",
        "c (ASD: 489.3 m from the nearest paint roof, beyond 5 m)",
        "d (ASD)",
    )
    # within 15 m, b lies between two paints; a second reading at the first paint may be of another paint
    again = hp.validate(paints, references.isel(spectrum=[1, 3]), place_accuracy=15.0)
    assert "ambiguous: 10.0 m from red-02, 12.2 m from hood, with an accuracy of 15 m" in str(
        again.unpaired_references
    )
    expect_error(
        SchemaError,
        r"by place: 2\.2 m from red-01, .* as 1 more of its instrument: readings of it, or of",
        lambda: hp.validate(paints, references.isel(spectrum=[0, 5])),
    )
    # a name that is asked for, or that a region states, needs no place
    stated = hp.validate(paints, references, {"roof": "c"})
    assert stated.statistics["reference"].values.tolist() == ["c"]


def test_pairs_that_are_said() -> None:
    paints = library([smooth(NM)] * 2, ("hood", "roof"))
    references = field([smooth(FIELD_NM)] * 2, ["a", "b"])
    found = hp.validate(paints, references, {"roof": "a"})
    assert (found.statistics["signature"].values.tolist(), found.unpaired_signatures) == (["roof"], ("hood",))
    refused = expect_error(
        SchemaError, None, lambda: hp.validate(paints, references, {"door": "a", "hood": ["a", "c"]})
    )
    assert refused.codes == ("paint-unknown", "reference-unknown")
    assert refused.problems[1].expected == "'a', 'b'"
    expect_errors((SchemaError, "reference-unmatched", lambda: hp.validate(paints, references)))
    expect_error(SchemaError, r"list.*type-wrong", lambda: hp.validate(paints, references, [("hood", "a")]))


def test_instruments_are_compared_apart(signatures: xr.Dataset, references: xr.Dataset) -> None:
    nm = np.arange(390.0, 1011.0, 1.5)
    other = field(1.1 * seen(nm, 3.5), nm=nm, fwhm=3.5, instrument="SVC")
    with pytest.warns(PaintWarning, match=r"VIS, NIR, all.*references-disagree"):
        found = hp.validate(signatures, [references, other])
    assert found.statistics.instrument.values.tolist() == ["ASD", "SVC"]
    np.testing.assert_allclose(found.statistics["scale"].sel(part="all"), [1.0, 1 / 1.1], rtol=1e-4)


def test_instruments_are_compared_with_each_other() -> None:
    # Expected: plain numpy of both on the coarser's channels, whatever the signature is; the mean of repeated
    # readings; and a verdict that decides nothing about the signature
    nm = np.arange(390.0, 1011.0, 1.5)
    paints = library(2.0 * PAINT)
    asd = field(np.outer([0.98, 1.02], LEVEL), ["hood_0", "hood_1"])
    svc = field(1.03 * seen(nm, 3.5), ["hood_s"], nm=nm, fwhm=3.5, instrument="SVC")
    found = hp.validate(paints, [asd, svc], {"hood": ["hood_0", "hood_1", "hood_s"]})
    assert not found.passed
    between = found.between
    assert between is not None
    assert between.statistics["instrument"].values.tolist() == ["ASD against SVC"]
    assert between.statistics["signature"].values.tolist() == ["hood"]
    expected = np.sqrt((((1.0 - 1.03) * seen(nm, 3.5)[((nm >= 400) & (nm < 700))]) ** 2).mean())
    assert value_of(between, "rmse", "VIS") == pytest.approx(expected, rel=2e-3)
    assert (value_of(between, "scale"), between.passed) == (pytest.approx(1 / 1.03, rel=1e-4), True)
    text = found.table()
    assert "references against one another" in text
    assert [line.split()[-1] for line in text.splitlines() if "ASD against SVC" in line] == ["pass"] * 3
    assert hp.validate(paints, [svc], {"hood": "hood_s"}).between is None


# --- what is within the tolerance --------------------------------------------------------------------------


@pytest.mark.parametrize("level", [0.003, 0.008, 0.015, 0.03, 0.06, 0.2, 0.5])
@pytest.mark.parametrize("error", [1.7, 1.0 / 1.7])
def test_seventy_percent_too_high_never_passes(level: float, error: float) -> None:
    # Rationale: an RMSE of 0.02 passed a black that was 70 % too high
    truth = field(np.full(FIELD_NM.size, level))
    found = hp.validate(library(np.full(NM.size, level * error)), truth)
    assert not found.passed
    assert not any(row.endswith("pass") for row in found.table().splitlines())
    # the right level passes, unless it is within the floor
    right = hp.validate(library(np.full(NM.size, level)), truth)
    assert right.passed == (level > 0.012)
    if not right.passed:
        assert "too dark for a tolerance of 0.00" in right.problems[0]


@pytest.mark.parametrize("level", [0.02, 0.1, 0.8])
def test_the_limit_is_a_share_of_the_level_and_a_floor(level: float) -> None:
    # Expected: 0.005 + 5 %, just inside passes and just outside fails; other shares as they are said
    truth = field(np.full(FIELD_NM.size, level))
    for tolerance, limit in ((None, 0.005 + 0.05 * level), ({"relative": 0.1, "floor": 0.0}, 0.1 * level)):
        for share, passes in ((0.99, True), (1.01, False), (-0.99, True), (-1.01, False)):
            found = hp.validate(library(np.full(NM.size, level + share * limit)), truth, tolerance=tolerance)
            assert found.passed is passes
            assert value_of(found, "rmse_limit") == pytest.approx(limit, rel=1e-5)
            assert value_of(found, "level") == pytest.approx(level, rel=1e-5)
    assert hp.validate(library(np.full(NM.size, level + 0.3)), truth, tolerance=0.31).passed


def test_every_row_says_whether_it_passes() -> None:
    paints = library([smooth(NM), 1.2 * smooth(NM)], ("hood", "roof"))
    table = hp.validate(paints, library([smooth(NM)] * 2, ("hood", "roof"))).table()
    rows = [line for line in table.splitlines() if "/" in line]
    assert [row.split()[-1] for row in rows if row.startswith("hood")] == ["pass"] * 3
    assert [row.split()[-1] for row in rows if row.startswith("roof")] == ["FAIL"] * 3


# --- what is refused, and what is told ---------------------------------------------------------------------


def test_a_panel_scales_what_is_relative(signatures: xr.Dataset, references: xr.Dataset) -> None:
    panel = panel_of(0.9)
    found = hp.validate(signatures, references, panel=panel)
    assert value_of(found, "scale") == pytest.approx(1 / 0.9, rel=1e-4)
    assert any("scaled by the panel" in note for note in found.notes[0])
    expect_errors((SchemaError, "option-conflict", lambda: hp.validate(signatures, signatures, panel=panel)))
    absolute = references.assign(
        reflectance=references["reflectance"].assign_attrs(reflectance_scale="absolute")
    )
    expect_refusals(
        (SchemaError, "option-conflict", lambda: hp.validate(signatures, absolute, panel=panel)),
        (SchemaError, "value-out-of-range", lambda: hp.validate(signatures, references, panel=panel * 100)),
    )
    left = hp.validate(
        signatures,
        references,
        panel=panel.assign_coords(wavelength=("wavelength", [500.0, 600.0], {"units": "nm"})),
    ).spectra[0]
    assert not left["used"].values[(NM < 500) | (NM > 600)].any()


def test_the_surface_of_a_panel_scales_by_the_sun(signatures: xr.Dataset, references: xr.Dataset) -> None:
    panel = panel_of(0.98)
    # summer and autumn at noon in Rochester: the sun at 21 and 54 degrees
    for day, zenith, factor in (("2021-07-01", 20.0, 1.057), ("2021-10-12", 50.9, 1.002)):
        placed = references.assign_coords(
            time=np.datetime64(f"{day}T17:10", "ns"), latitude=43.1, longitude=-77.6
        )
        found = hp.validate(signatures, placed, panel=panel, panel_surface="sintered-ptfe")
        assert any(f"a sun at {zenith:.0f} degrees" in note for note in found.notes[0])
        # factors of direct light; a clear sky adds a tenth without them
        share = 0.9 * (factor - 1.0)
        assert value_of(found, "scale") == pytest.approx(1 / 0.98 / (1.0 + share), abs=6e-3)
    expect_refusals(
        (
            SchemaError, "panel-light-unknown", "time and place",
            lambda: hp.validate(signatures, references, panel=panel, panel_surface="sintered-ptfe"),
        ),
        (
            SchemaError, "panel-surface-unknown", "glossy",
            lambda: hp.validate(signatures, placed, panel=panel, panel_surface="glossy"),
        ),
    )  # fmt: skip


def test_matched_detectors_are_told(signatures: xr.Dataset, references: xr.Dataset) -> None:
    told = references.assign_coords(
        overlap=("spectrum", np.array(["removed @ 970, 1901 nm"], object)),
        overlap_matched=("spectrum", [True]),
    )
    found = hp.validate(signatures, told)
    assert found.statistics.overlap_matched.item()
    assert found.statistics.overlap.item() == "removed @ 970, 1901 nm"
    assert "the reference is overlap-matched" in found.table()
    unknown = hp.validate(signatures, references)
    assert unknown.statistics.overlap.item() == "unknown"
    assert "overlap-matched" not in unknown.table()


def test_mirrored_sky_on_one_side_only_warns(signatures: xr.Dataset, references: xr.Dataset) -> None:
    body = signatures.assign(reflectance=signatures["reflectance"].assign_attrs(mirror_reflection="excluded"))
    whole = references.assign_attrs(mirror_reflection="included")
    with pytest.warns(PaintWarning, match="mirrored-sky-differs") as noted:
        hp.validate(body, whole)
    assert noted[0].filename == __file__  # the line of the caller
    hp.validate(body, references)
    hp.validate(body, references.assign_attrs(mirror_reflection="excluded"))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"tolerance": {"colour": 1.0}}, "choice-unknown"),
        ({"tolerance": -1.0}, "value-out-of-range"),
        ({"tolerance": {}}, "argument-missing"),
        ({"tolerance": {"floor": 0.01}}, "option-conflict"),
        ({"parts": {}}, "type-wrong"),
        ({"parts": {"x": (700.0, 400.0)}}, "type-wrong"),
        ({"references": []}, "empty-input"),
        ({"references": "svc/*.sig"}, "type-wrong"),
        ({"references": field(smooth(INFRARED), nm=INFRARED)}, "range-disjoint"),
        ({"references": xr.Dataset({"radiance": ("x", [1.0])})}, "variable-missing"),
        ({"signatures": xr.Dataset()}, "'reflectance' is missing"),
        ({"signatures": 3}, "type-wrong"),
    ],
)
def test_wrong_calls(
    signatures: xr.Dataset, references: xr.Dataset, change: dict[str, Any], told: str
) -> None:
    call = {"signatures": signatures, "references": references, **change}
    expect_errors(
        (SchemaError, told, lambda: hp.validate(call.pop("signatures"), call.pop("references"), **call))
    )


def test_parts_without_bands_are_not_judged(signatures: xr.Dataset, references: xr.Dataset) -> None:
    found = hp.validate(signatures.isel(band=slice(0, 20)), references)
    assert found.statistics["bands"].sel(part="NIR").item() == 0
    assert np.isnan(value_of(found, "rmse", "NIR"))
    assert found.passed
    assert " NIR " not in found.table()


def test_tolerance_of_several_statistics(signatures: xr.Dataset, references: xr.Dataset) -> None:
    brighter = signatures.assign(reflectance=(signatures["reflectance"] * 1.1).assign_attrs(units="1"))
    assert hp.validate(brighter, references, tolerance={"spectral_angle": 0.06, "scale": 0.11}).passed
    assert not hp.validate(brighter, references, tolerance={"spectral_angle": 0.06, "scale": 0.09}).passed


def test_texts_are_only_texts() -> None:
    paints = library(smooth(NM), (("<b>\x1b[31m$x$\n" + "long " * 20),))
    found = hp.validate(paints, paints.assign_attrs(instrument="<i>"))
    assert "\x1b" not in found.table()
    assert max(map(len, found.table().splitlines()[:4])) < 250
    assert repr(found).startswith("<Validation>")
    page = found._repr_html_()
    expect_words(page, without=("<b>", "<i>"))
    html.parser.HTMLParser().feed(page)


def test_dtypes_and_units() -> None:
    table = hp.validate(*agreeing()).statistics
    for name in ("bias", "rmse", "mae", "scale", "scale_free_error", "coverage", "oxygen_residual"):
        assert (table[name].dtype, table[name].attrs["units"]) == (np.float64, "1")
    assert (table["spectral_angle"].attrs["units"], table["bands"].dtype) == ("degree", np.int64)
    assert table["passes"].dtype == bool
    assert all(array.attrs["long_name"] for array in table.data_vars.values())


# --- Which readings belong together: of one name, one folder and one instrument ---


def red() -> xr.Dataset:
    # Return a library of one paint, red
    return library(PAINT, ("red",))


def write_sig(path: Path, level: float, head: str = "") -> None:
    rows = "".join(
        f"{nm:.1f}  8000.00  {8000 * level:.2f}  {100 * level:.2f}\n" for nm in np.arange(350, 1050, 1.5)
    )
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"/*** Spectra Vista SIG Data ***/\n{head}units= Radiance, Radiance\ndata= \n{rows}")


def test_one_name_in_two_folders_or_datasets_is_no_repeat() -> None:
    two = field([LEVEL + 0.2, LEVEL - 0.2], ["site1/red.sig", "site2/red.sig"])
    datasets = [field(LEVEL + 0.2, ["red"]), field(LEVEL - 0.2, ["red"])]
    expect_refusals(
        (SchemaError, "reference-ambiguous", "site1/red", "site2/red", lambda: hp.validate(red(), two)),
        (SchemaError, "reference-ambiguous", "dataset 2", lambda: hp.validate(red(), datasets)),
    )
    assert hp.validate(red(), two, {"red": "site1/red"}).statistics["reference"].values.tolist() == [
        "site1/red.sig"
    ]
    with pytest.warns(PaintWarning, match="reference-scatter"):
        both = hp.validate(red(), two, {"red": ["site1/red.sig", "site2/red.sig"]})
    assert any("show one paint" in note for note in both.notes[0])


def test_full_names_go_before_short_ones_and_equal_ones_are_repeats() -> None:
    found = hp.validate(red(), field([LEVEL, LEVEL + 0.3], ["red", "other/red.sig"]))
    assert found.statistics["reference"].values.tolist() == ["red"]
    assert found.unpaired_references == ("other/red.sig (ASD)",)
    # each instrument for itself, and readings of one folder are repeats
    for references, names in (
        ([field(LEVEL, ["red"]), field(LEVEL, ["svc/red.sig"], instrument="SVC")], ["red", "svc/red.sig"]),
        (field([LEVEL, LEVEL], ["red", "red"]), ["red, red"]),
    ):
        assert hp.validate(red(), references).statistics["reference"].values.tolist() == names


def test_files_of_open_svc(tmp_path: Path) -> None:
    for folder, level in (("site1", 0.5), ("site2", 0.1)):
        write_sig(tmp_path / folder / "red.sig", level, "time= 27.05.2025 09:39:32, 27.05.2025 09:42:59\n")
    both = hp.open_svc([tmp_path / "site1", tmp_path / "site2"], utc_offset_h=2)
    paints = library(np.full(NM.size, 0.3), ("red",))
    expect_refusals((SchemaError, "reference-ambiguous", "site2/red", lambda: hp.validate(paints, both)))
    for name in ("site1/red", "site1/red.sig"):
        assert float(
            hp.validate(paints, both, {"red": name}).statistics["bias"].sel(part="all").item()
        ) == pytest.approx(-0.2, abs=1e-3)
    # folders of one name, which the reader numbers
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_sig(
            tmp_path / folder / "svc" / "red.sig", 0.3, "time= 27.05.2025 09:39:32, 27.05.2025 09:42:59\n"
        )
    numbered = hp.open_svc([tmp_path / "a" / "svc", tmp_path / "b" / "svc"], utc_offset_h=2)
    expect_refusals((SchemaError, "reference-ambiguous", "red (2)", lambda: hp.validate(paints, numbered)))


def test_instruments_of_one_make_are_compared_apart(tmp_path: Path) -> None:
    times = "time= 27.05.2025 09:39:32, 27.05.2025 09:42:59\n"
    for serial, level in ((1, 0.31), (2, 0.29)):
        write_sig(
            tmp_path / f"s{serial}" / "red.sig",
            level,
            f"instrument= HI: {serial} (HR-1024i)\nerror= 0, {serial}\n{times}",
        )
    both = hp.open_svc([tmp_path / "s1", tmp_path / "s2"], utc_offset_h=2)
    with pytest.warns(PaintWarning, match=r"HI: 2.*references-disagree"):
        found = hp.validate(library(np.full(NM.size, 0.3), ("red",)), both)
    assert found.statistics["instrument"].values.tolist() == ["SVC HI: 1 (HR-1024i)", "SVC HI: 2 (HR-1024i)"]
    np.testing.assert_allclose(found.statistics["bias"].sel(part="all"), [-0.01, 0.01], atol=1e-4)
    assert "the instrument set error bits 1 in the target scan" in found.notes[0]
    assert "the instrument set error bits 2 in the target scan" in found.notes[1]
    # one alone needs no number
    assert hp.validate(library(np.full(NM.size, 0.3), ("red",)), both.isel(spectrum=[0])).statistics[
        "instrument"
    ].values.tolist() == ["SVC"]


def test_paints_of_one_name_are_refused() -> None:
    paints = library([seen(NM, 6.0)] * 2, ("hood", "hood"))
    refused = expect_error(SchemaError, None, lambda: hp.validate(paints, agreeing()[1]))
    assert refused.codes == ("paint-duplicate",) * 2
    # each names its own
    assert (
        hp.validate(
            paints.assign_coords(reference=("signature", np.array(["a", "b"], object))),
            field([LEVEL] * 2, ["a", "b"]),
        ).statistics.sizes["pair"]
        == 2
    )


def test_a_relative_reference_without_its_panel_is_told(
    signatures: xr.Dataset, references: xr.Dataset
) -> None:
    told = "the reference is relative to a white panel, the signature is absolute"
    assert any(
        told in note and "pass panel=" in note for note in hp.validate(signatures, references).notes[0]
    )
    absolute = references.assign(
        reflectance=references["reflectance"].assign_attrs(reflectance_scale="absolute")
    )
    assert not any("white panel" in note for note in hp.validate(signatures, absolute).notes[0])
    assert any(
        "the signature is relative to a white panel" in note
        for note in hp.validate(
            signatures.assign(
                reflectance=signatures["reflectance"].assign_attrs(reflectance_scale="relative")
            ),
            absolute,
        ).notes[0]
    )


# --- What the uncertainties of a comparison are made of, and what is said where some are not known ---


def readings(count: int, **spreads: float) -> hp.validation.Validation:
    # Compare a paint with readings that are nearly the same, of known uncertainty
    values = LEVEL + 1e-5 * np.arange(count)[:, None]
    made = field(values, ["hood"] * count)
    for name, value in spreads.items():
        made[f"reflectance_{name}"] = ("spectrum", "wavelength"), np.full(values.shape, value), {"units": "1"}
    return hp.validate(library(PAINT), made)


def test_repeating_does_not_lessen_what_is_systematic() -> None:
    for count in (1, 2, 5):
        assert value_of(readings(count, u_systematic=0.03), "bias_u") == pytest.approx(0.03, rel=0.1)


def test_readings_that_agree_by_chance_keep_their_noise() -> None:
    one, four = (readings(count, u_random=0.01).spectra[0]["reference_u"].median() for count in (1, 4))
    assert float(four) == pytest.approx(0.5 * float(one), rel=0.1)
    assert float(four) > 0.001


def test_what_is_known_of_some_bands_only() -> None:
    u = np.full(NM.size, np.nan)
    u[:60] = 0.005  # VIS, hardly any of NIR
    found = hp.validate(library(PAINT, reflectance_u_random=u), field(LEVEL))
    assert 700.0 < NM[59] < 710.0
    assert value_of(found, "bias_u", "VIS") > 0.0
    assert np.isnan(value_of(found, "bias_u", "NIR"))
    assert np.isnan(value_of(found, "bias_u", "all"))
    assert np.isnan(found.spectra[0]["signature_u"].values[60:]).all()
    told = "uncertainty of the signature: random part known in 60 of 117 channels"
    assert any(told in note for note in found.notes[0])


@pytest.mark.parametrize("known", ["random", "systematic"])
def test_one_part_is_said_to_be_one_part(known: str) -> None:
    other = {"random": "systematic", "systematic": "random"}[known]
    assert (
        f"uncertainty of the signature: {known} part only, the {other} part is unknown"
        in hp.validate(
            library(PAINT, **{f"reflectance_u_{known}": np.full(NM.size, 0.005)}), field(LEVEL)
        ).notes[0]
    )
    both = hp.validate(
        library(PAINT, **{f"reflectance_u_{name}": np.full(NM.size, 0.005) for name in (known, other)}),
        field(LEVEL),
    )
    assert not any("part only" in note for note in both.notes[0])


def test_pixels_that_are_not_independent_do_not_count() -> None:
    paints = library(PAINT, reflectance_sd=np.full(NM.size, 0.03)).assign(
        n=("signature", [10_000], {"units": "1"}), n_eff=("signature", [25.0], {"units": "1"})
    )
    assert value_of(hp.validate(paints, field(LEVEL)), "bias_u") == pytest.approx(0.03 / 5, rel=0.1)
    assert value_of(
        hp.validate(paints.assign(n_eff=("signature", [np.nan], {"units": "1"})), field(LEVEL)), "bias_u"
    ) == pytest.approx(0.03 / 100, rel=0.1)


def test_errors_of_opposite_signs_leave_the_mean_over_bands() -> None:
    # an error of wavelength on both flanks of a peak: large in every band, nothing in their mean
    u = np.full(NM.size, 0.01)
    signs = np.where(np.arange(NM.size) % 2, 1.0, -1.0)[None, None]
    paints = library(PAINT, reflectance_u_random=1e-5 * u, reflectance_u_systematic=u)
    alike = hp.validate(paints, field(LEVEL))
    lags = np.ones((1, 1, NM.size))
    by_source = paints.assign(
        reflectance_errors=(("signature", "error_source", "band"), 0.01 * signs, {"units": "1"}),
        error_correlation=(("signature", "lag", "band"), lags, {"units": "1"}),
    ).assign_coords(error_source=["wavelength"], error_form=("error_source", ["band systematic"]))
    apart = hp.validate(by_source, field(LEVEL))
    for each in (alike, apart):
        assert float(each.spectra[0]["signature_u"].median()) == pytest.approx(0.01, rel=0.1)
    assert value_of(alike, "bias_u") == pytest.approx(0.01, rel=0.1)
    assert value_of(apart, "bias_u") < 0.001


# --- What must not pass: what was not compared, and what has no reference ---


def test_a_part_that_is_asked_for_needs_bands(signatures: xr.Dataset, references: xr.Dataset) -> None:
    found = hp.validate(signatures, references, parts={"red": (600.0, 700.0), "SWIR": (1500.0, 1700.0)})
    assert found.statistics["passes"].values.tolist() == [[True, False]]
    assert (found.statistics["judged"].values.tolist(), found.passed) == ([[True, False]], False)
    assert found.problems == ("hood against hood of ASD: SWIR (0 of 0 bands, too few to judge)",)
    assert "0 of 1 pair within tolerance" in found.verdict


def test_a_single_band_passes_nothing() -> None:
    values = np.full(NM.size, np.nan)
    values[60] = 0.9
    limits = {"spectral_angle": 0.01, "scale_free_error": 0.01}
    found = hp.validate(library(values), agreeing()[1], tolerance=limits)
    assert (found.statistics["bands"].sel(part="all").item(), found.passed) == (1, False)
    for name in limits:
        assert np.isnan(value_of(found, name))
        assert np.isnan(value_of(found, f"{name}_u"))
    assert not found.statistics["passes"].any()


def test_few_of_many_bands_pass_nothing_yet_can_fail() -> None:
    signatures, _ = agreeing()
    nm = np.arange(380.0, 541.0)  # most of VIS is not seen, NIR not at all
    few = field(seen(nm, 3.0), nm=nm)
    found = hp.validate(signatures, few)
    assert (found.statistics["judged"].values.tolist(), found.passed) == ([[False, False, False]], False)
    assert "FAIL" not in found.table()
    assert "not judged: VIS (" in found.table()
    # a part that names what is seen is judged
    assert hp.validate(signatures, few, parts={"blue": (400.0, 530.0)}).passed
    # all of the spectrum is not judged, but VIS is, which suffices
    nm = np.arange(380.0, 690.0)
    most = hp.validate(signatures, field(seen(nm, 3.0), nm=nm))
    assert (most.statistics["judged"].values.tolist(), most.passed) == ([[True, False, False]], True)
    assert "not judged" in most.table()
    # what is outside fails, judged or not
    nm = np.arange(380.0, 800.0)
    outside = hp.validate(signatures, field(seen(nm, 3.0) + np.where(nm > 720, 0.2, 0.0), nm=nm))
    assert outside.statistics["judged"].sel(part="NIR").item() is False
    assert outside.statistics["passes"].sel(part="NIR").item() is False
    assert outside.statistics["passes"].sel(part="VIS").item() is True


def test_a_reference_that_is_asked_for_must_be_there() -> None:
    found = hp.validate(
        library([smooth(NM)] * 2, ("red", "blue")).assign_coords(
            reference=("signature", np.array(["", "blu.sig"], object))
        ),
        library([smooth(NM)] * 2, ("red", "blue")),
    )
    assert found.missing == ("blue (no reference 'blu.sig')",)
    assert found.statistics["passes"].all()
    assert not found.passed
    assert found.problems == ("blue (no reference 'blu.sig'): its reference is missing",)
    assert found.verdict.endswith("1 of 2 paints compared")


def test_all_paints_can_be_required() -> None:
    paints = library([smooth(NM)] * 2, ("red", "blue"))
    references = paints.isel(signature=[0])
    assert hp.validate(paints, references).passed
    found = hp.validate(paints, references, require_all=True)
    assert (found.missing, found.passed) == ((("blue",)), False)


@pytest.mark.parametrize("wrong", [1e-7, 1e-3, 1e4])
def test_widths_of_channels_have_bounds(signatures: xr.Dataset, references: xr.Dataset, wrong: float) -> None:
    widths = np.full(references.sizes["wavelength"], 3.0)
    widths[150] = wrong
    bad = references.assign_coords(fwhm=("wavelength", widths, {"units": "nm"}))
    expect_refusals(
        (SchemaError, "value-out-of-range", lambda: hp.validate(signatures, bad)),
        (
            SchemaError,
            "value-out-of-range",
            lambda: hp.validate(signatures, references, reference_fwhm=wrong),
        ),
    )


# --- Statistics of agreement: against plain numpy, and what no data can change ---

SPECTRA = arrays(np.float64, 12, elements=st.floats(0.01, 1.0))


def test_statistics_by_hand() -> None:
    s, r = np.array([0.2, 0.5, 0.4]), np.array([0.1, 0.5, 0.5])
    found = {name: float(value) for name, value in statistics_of(s, r).items()}
    assert (found["bias"], found["mae"]) == (pytest.approx(0.0, abs=1e-15), pytest.approx(0.2 / 3))
    assert found["rmse"] == pytest.approx(math.sqrt(0.02 / 3))
    dot, ss, rr = 0.02 + 0.25 + 0.2, 0.04 + 0.25 + 0.16, 0.01 + 0.25 + 0.25
    assert found["spectral_angle"] == pytest.approx(math.degrees(math.acos(dot / math.sqrt(ss * rr))))
    k = dot / rr
    assert found["scale"] == pytest.approx(k)
    left = [(a / k - b) ** 2 for a, b in zip(s, r, strict=True)]
    assert (found["scale_free_error"], found["scale_free_error"]) == (
        pytest.approx(math.sqrt(sum(left) / 3)),
        pytest.approx(math.tan(math.radians(found["spectral_angle"])) * math.sqrt(rr / 3)),
    )


@given(SPECTRA, SPECTRA, st.floats(0.2, 5.0))
def test_statistics_of_any_spectra(s: np.ndarray, r: np.ndarray, factor: float) -> None:
    one, other, swapped = statistics_of(s, r), statistics_of(factor * s, r), statistics_of(r, s)
    # what a factor does not change
    assert other["scale_free_error"] == pytest.approx(one["scale_free_error"], rel=1e-9, abs=1e-12)
    assert other["spectral_angle"] == pytest.approx(one["spectral_angle"], rel=1e-7, abs=1e-12)
    assert other["scale"] == pytest.approx(factor * one["scale"])
    # order of sizes, and of the spectra
    assert abs(one["bias"]) <= one["mae"] + 1e-15
    assert one["mae"] <= one["rmse"] + 1e-15
    assert swapped["bias"] == pytest.approx(-one["bias"], abs=1e-15)
    for name in ("rmse", "mae", "spectral_angle"):
        assert swapped[name] == pytest.approx(one[name], abs=1e-12)
    # equal spectra, and equal shapes
    same = statistics_of(s, s)
    assert [float(same[name]) for name in ("bias", "rmse", "mae", "spectral_angle")] == [0.0] * 4
    assert same["scale"] == pytest.approx(1.0, abs=1e-15)
    assert same["scale_free_error"] < 1e-15
    assert statistics_of(factor * s, s)["spectral_angle"] < 1e-13


def test_nothing_gives_nothing() -> None:
    none = statistics_of(np.zeros(0), np.zeros(0))
    assert set(none) == set(STATISTICS)
    assert all(np.isnan(value) for value in none.values())
    dark = statistics_of(np.zeros(4), np.full(4, 0.2))
    assert dark["rmse"] == pytest.approx(0.2)
    assert np.isnan(dark["spectral_angle"])
    assert np.isnan(dark["scale_free_error"])
    assert np.isnan(statistics_of(np.full(4, 0.2), np.zeros(4))["scale"])


def test_draws_agree_with_linear_propagation() -> None:
    rng = np.random.default_rng(1)
    r = np.linspace(0.2, 0.6, 40)
    s = 1.05 * r + 0.01
    random, common = np.full(40, 0.004), 0.01 * r
    draws = 4000
    own = random * rng.standard_normal((draws, 40)) + common * rng.standard_normal((draws, 1))
    found = uncertainty_of(s, r, own, np.zeros_like(own))
    d = s - r
    slopes = {
        "bias": np.full(40, 1 / 40),
        "mae": np.sign(d) / 40,
        "rmse": d / (40 * np.sqrt((d**2).mean())),
        "scale": r / (r**2).sum(),
    }
    for name, slope in slopes.items():
        assert found[name] == pytest.approx(
            math.sqrt(((slope * random) ** 2).sum() + (slope * common).sum() ** 2), rel=0.06
        ), name


def test_equal_spectra_are_not_sure_beyond_their_noise() -> None:
    rng = np.random.default_rng(2)
    s = np.full(50, 0.3)
    noise = 0.01 * rng.standard_normal((2000, 50))
    found = uncertainty_of(s, s, noise, np.zeros_like(noise))
    assert found["rmse"] == pytest.approx(0.01, rel=0.03)
    assert found["bias"] == pytest.approx(0.01 / math.sqrt(50), rel=0.06)


# --- The body under a coat against readings of its outside: converted where they say how, named where not ---

NM_COATS = np.linspace(420.0, 980.0, 113)
ALBEDO = 0.3 + 0.5 * (NM_COATS - 420.0) / 560.0
NEAR = coated_reflectance(ALBEDO)


def signature(values: np.ndarray = NEAR, quantity: str = BODY, **more: Any) -> xr.Dataset:
    component = "included" if quantity == OUTSIDE else "excluded"
    attrs = {"units": "1", "quantity": quantity, "specular_component": component}
    variables = {name: ("signature", [value]) for name, value in more.items()}
    return xr.Dataset(
        {"reflectance": (("signature", "band"), values[None].astype(np.float32), attrs), **variables},
        {"signature": ["hood"], "wavelength": ("band", NM_COATS, {"units": "nm"})},
    )


def reading(values: np.ndarray, **attrs: Any) -> xr.Dataset:
    return xr.Dataset(
        {"reflectance": (("spectrum", "wavelength"), values[None], {"units": "1", **attrs})},
        {"wavelength": ("wavelength", NM_COATS, {"units": "nm"}), "spectrum": ["hood"]},
    )


def scale(*pair: xr.Dataset) -> float:
    return float(hp.validate(*pair, reference_fwhm=5.0).statistics.bias.sel(part="all").item())


@pytest.mark.parametrize(
    ("geometry", "included"), [("d/8", True), ("d/8", False), ("0/0", True), ("45/0", False)]
)
def test_readings_of_the_outside_are_brought_to_the_body(geometry: str, included: bool) -> None:
    # What instruments read of a base under a coat is the renderer's
    seen = coated_reflectance(
        ALBEDO, geometry={"d/8": "d/0", "45/0": "0/45"}.get(geometry, geometry), specular_included=included
    )
    assert np.abs(seen / NEAR - 1.0).max() > 0.001
    field = reading(
        seen,
        quantity=OUTSIDE,
        specular_component="included" if included else "excluded",
        measurement_geometry=geometry,
    )
    one = hp.validate(signature(), field, reference_fwhm=5.0)
    assert np.abs(one.statistics.bias).max() < 2e-4
    assert any("converted to the body" in note for note in one.notes[0])
    if included:  # as it is where the signature is of the outside too
        assert not any("converted" in note for note in hp.validate(signature(seen, OUTSIDE), field).notes[0])


def test_what_cannot_be_converted_is_named() -> None:
    outside = reading(NEAR + 0.04, quantity=OUTSIDE, specular_component="included")
    with pytest.warns(PaintWarning, match="coats-differ"):
        assert scale(signature(), outside) == pytest.approx(-0.04, abs=1e-3)
    for quantity, mend in ((THROUGH_COAT, "coat=True"), (OUTSIDE, "specular_sky=True")):
        with pytest.warns(PaintWarning, match=mend):
            hp.validate(signature(quantity=quantity), reading(NEAR, quantity=BODY), reference_fwhm=5.0)
    hp.validate(signature(), reading(NEAR), reference_fwhm=5.0)  # of what it is nothing is said


def test_the_light_leaves_less_to_be_judged() -> None:
    assert any(
        "80 degrees from the zenith" in note
        for note in hp.validate(signature(sun_zenith=80.0), reading(NEAR)).notes[0]
    )
    odd = signature(sun_zenith=40.0, sky_state=np.int8(SKY_STATES.index("contradictory")))
    share = (("signature", "band"), np.full((1, NM_COATS.size), 0.4), {"units": "1"})
    stored = odd.assign(diffuse_fraction=share).chunk(signature=1)  # as it comes from a store
    assert any("contradicted" in note for note in hp.validate(stored, reading(NEAR)).notes[0])
    assert not any("contradicted" in note for note in hp.validate(odd, reading(NEAR)).notes[0])


def test_a_metallic_is_judged_at_the_geometry_of_its_reference_only() -> None:
    paints, reference = agreeing()
    wrong = paints.assign(reflectance=(paints["reflectance"] * np.float32(1.5)).assign_attrs(units="1"))

    def seen_at(angle: float, finish: str = "metallic") -> xr.Dataset:
        return wrong.assign_coords(finish=("signature", [finish])).assign(
            aspecular_angle=("signature", [angle], {"units": "degree"})
        )

    unstated = hp.validate(seen_at(46.0), reference)
    assert not unstated.passed
    assert "holds for one geometry only, and the reference states none" in unstated.problems[0]
    judged = hp.validate(seen_at(46.0), reference.assign_attrs(measurement_geometry="45/0"))
    assert judged.problems == ("hood against hood of ASD: VIS, NIR, all",)
    # the sun of the reading: 20 degrees from the zenith, and a solid paint is judged under any sun
    noon = np.datetime64("2021-06-21T17:12", "ns")
    field_day = reference.assign_coords(
        time=("spectrum", [noon]), latitude=("spectrum", [43.08]), longitude=("spectrum", [-77.67])
    )
    assert "20 degrees from the mirror direction" in hp.validate(seen_at(20.0), field_day).problems[0]
    assert hp.validate(seen_at(20.0, "solid"), field_day).problems == judged.problems
    assert (
        "20 degrees from the mirror direction" in hp.validate(seen_at(20.0, "Pearl"), field_day).problems[0]
    )
    # the view of the camera is not taken as from the nadir
    placed = {name: ("signature", field_day[name].values) for name in ("time", "latitude", "longitude")}
    nowhere = seen_at(np.nan).assign(placed)
    assert "the signature states none" in hp.validate(nowhere, field_day).problems[0]
    # beside a pair that is judged, the other does not fail
    both = xr.concat(
        [seen_at(20.0), paints.assign(seen_at(20.0, "solid")[["finish", "aspecular_angle"]])], "signature"
    )
    both = both.assign_coords(signature=["hood", "roof"])
    found = hp.validate(both, [reference, reference.assign_coords(spectrum=["roof"])])
    assert (found.passed, found.verdict[:11]) == (True, "1 of 1 pair")
    assert found.verdict.endswith("1 pair not judged")
    assert "not judged" in found.table()


# --- Real spectra of a field spectrometer, at the bands of a real camera ---


def _insitu(path: Path) -> xr.Dataset:
    nm, mean, sd = np.loadtxt(path, comments="#", unpack=True, encoding="latin-1")
    return field(mean, (path.stem.removeprefix("insitu_"),), nm=nm, fwhm=None).assign(
        reflectance_sd=(("spectrum", "wavelength"), sd[None], {"units": "1"})
    )


def _bands(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    table = np.loadtxt(folder / "20170320_ang20170228_wavelength_fit.txt")
    return 1e3 * table[:, 1], 1e3 * table[:, 2]


@pytest.mark.real_data
def test_field_spectra_at_the_bands_of_a_real_camera(shared_data: Path) -> None:
    # The width that is missing between an ASD and AVIRIS-NG, by a plain convolution
    folder = shared_data / "radiance_vs_field"
    lawn = _insitu(folder / "insitu_BeckmanLawn.txt")
    at = lawn["wavelength"].values
    centre, fwhm = _bands(folder)
    here = (centre > 400) & (centre < 980)
    centre, fwhm = centre[here], fwhm[here]
    weight = np.exp(-4 * np.log(2) * ((at - centre[:, None]) / np.sqrt(fwhm**2 - 3.0**2)[:, None]) ** 2)
    paints = library(
        weight @ lawn["reflectance"].values[0] / weight.sum(axis=1), ("BeckmanLawn",), nm=centre, fwhm=None
    ).assign_coords(fwhm=("band", fwhm, {"units": "nm"}))
    found = hp.validate(paints, lawn)
    assert found.statistics["bands"].sel(part="all").item() == here.sum()
    assert value_of(found, "rmse") < 1e-4
    assert any("as usual for ASD" in note for note in found.notes[0])
    assert value_of(found, "scale_u") > 0.02  # of 68 readings whose number is not told


@pytest.mark.real_data
def test_red_turf_from_the_air_against_the_field(shared_data: Path) -> None:
    # AVIRIS-NG with the lawn for a panel: colour as on the ground, level to some per cent
    folder = shared_data / "radiance_vs_field"
    centre, fwhm = _bands(folder)
    field_lawn, field_red = (
        _insitu(folder / f"insitu_{name}.txt") for name in ("BeckmanLawn", "AstroRedBaseball")
    )
    nm, red = np.loadtxt(folder / "ang20171108t184227_rdn_v2p11_AstroRedBaseball.txt", unpack=True)
    lawn = np.loadtxt(folder / "ang20171108t184227_rdn_v2p11_BeckmanLawn.txt")[:, 1]
    np.testing.assert_allclose(nm, centre, atol=0.1)
    here = (centre > 560) & (centre < 690)  # little path radiance, little of the lawn's red edge
    paints = library(
        (np.interp(centre, field_lawn["wavelength"], field_lawn["reflectance"].values[0]) * red / lawn)[here],
        ("AstroRedBaseball",),
        nm=centre[here],
        fwhm=None,
    )
    paints = paints.assign_coords(fwhm=("band", fwhm[here], {"units": "nm"}))
    found = hp.validate(paints, field_red, tolerance=1.0)
    assert value_of(found, "spectral_angle") < 12.0
    assert 0.6 < value_of(found, "scale") < 1.5


@pytest.mark.real_data
def test_real_files_of_an_svc_before_and_after_matching(shared_data: Path) -> None:
    # The vendor's matching moves reflectance below the join; which file that is, the result says
    folder = shared_data / "svc_sig"
    raw, matched = (hp.open_svc(folder / f"BNL13001_000{end}.sig", utc_offset_h=0.0) for end in ("", "_moc"))
    found = []
    for source in (raw, matched):
        at = source["wavelength"].values[:512]
        first = source["reflectance"].values[0, :512]
        bands = np.arange(420.0, 950.0, 5.0)
        missing = np.sqrt(6.0**2 - 3.5**2)
        weight = np.exp(-4 * np.log(2) * ((at[at < 965] - bands[:, None]) / missing) ** 2)
        weight *= np.gradient(at[at < 965])
        found.append(
            hp.validate(
                library(
                    weight @ first[at < 965] / weight.sum(axis=1),
                    (str(source["spectrum"].values[0]),),
                    nm=bands,
                ),
                source,
            )
        )
    for one in found:
        assert value_of(one, "rmse") < 2e-4
    assert found[0].statistics.overlap.item() == "preserved"
    assert not found[0].statistics.overlap_matched.item()
    assert found[1].statistics.overlap_matched.item()
    assert "the reference is overlap-matched" in found[1].table()
    apart = hp.validate(
        library(
            found[0].spectra[0]["signature"].values, ("BNL13001_000_moc",), nm=np.arange(420.0, 950.0, 5.0)
        ),
        matched,
        tolerance=0.005,
    )
    # the known values at 550 nm: 8.49 % before, 8.35 % after
    assert apart.spectra[0]["difference"].values[
        np.abs(np.arange(420.0, 950.0, 5.0) - 550).argmin()
    ] == pytest.approx(0.0849 - 0.0835, abs=3e-4)
    assert value_of(apart, "bias", "NIR") > 0.005
    assert not apart.passed


@pytest.mark.real_data
def test_a_white_reference_seen_as_a_target_is_white(shared_data: Path) -> None:
    white = hp.open_svc(
        shared_data / "svc_sig" / "ACPL_D2_P1_T_1_WR_000.sig", dayfirst=False, utc_offset_h=-5.0
    )
    bands = np.arange(420.0, 900.0, 5.0)
    paint = library(np.ones(bands.size), ("panel",), nm=bands)
    found = hp.validate(paint, white, {"panel": "ACPL_D2_P1_T_1_WR_000"})
    assert abs(value_of(found, "scale") - 1.0) < 0.005
    panel = hp.io.read_certificate(shared_data / "spectra_ascii" / "R90.txt")
    scaled = hp.validate(
        library(np.ones(bands.size), ("panel",), nm=bands), white, {"panel": "ACPL_D2_P1_T_1_WR_000"},
        panel=panel, tolerance=1.0,
    )  # fmt: skip
    expected = 1 / np.interp(bands, panel["wavelength"], panel).mean()
    assert value_of(scaled, "scale") == pytest.approx(expected, rel=0.01)


# --- one pigment panel by five laboratories with cameras, beside a spectrophotometer

SAMPLES = (
    *("burnt umber thin", "burnt umber thick", "carmine thin", "carmine thick", "vermilion thin"),
    *("vermilion thick", "malachite thin", "malachite thick", "azurite thin", "azurite thick"),
    *("lead white", "ivory black", "gypsum ground"),
)
LABORATORIES = {
    "Hyspex_VNIR1600": 0.038, "Hyspex_VNIR1800": 0.038, "Specim_V10E_1": 0.035, "Specim_V10E_2": 0.041,
    "Specim_V10E_3": 0.047,
}  # fmt: skip


def reference(folder: Path) -> xr.Dataset:
    table = np.loadtxt(folder / "pigment_panel_reference.csv")
    table = table[table[:, 0] < 1100.0]
    return field(table[:, 1:].T, SAMPLES, nm=table[:, 0], fwhm=None, instrument="spectrophotometer")


def laboratory(folder: Path, name: str) -> tuple[xr.Dataset, np.ndarray]:
    # Return a laboratory's library, and its RMSE by a plain interpolation (sample,)
    table = np.loadtxt(folder / f"{name}.csv")
    table = table[(table[:, 0] >= 420.0) & (table[:, 0] <= 950.0)]
    known = np.loadtxt(folder / "pigment_panel_reference.csv")
    away = [
        table[:, 2 + k] - np.interp(table[:, 0], known[:, 0], known[:, 1 + k]) for k in range(len(SAMPLES))
    ]
    return library(table[:, 2:].T, SAMPLES, nm=table[:, 0], fwhm=None), np.sqrt(
        (np.array(away) ** 2).mean(axis=1)
    )


def validated(paints: xr.Dataset, references: xr.Dataset) -> tuple[np.ndarray, list[str]]:
    # Return the RMSE of every paint, and what was said
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        agreement = hp.validate(paints, references)
    return np.array([value_of(agreement, "rmse", pair=pair) for pair in range(paints.sizes["signature"])]), [
        str(each.message) for each in said
    ]


@pytest.mark.real_data
@pytest.mark.parametrize("name", LABORATORIES)
def test_a_laboratorys_own_figures(shared_data: Path, name: str) -> None:
    folder = shared_data / "round_robin"
    paints, plain = laboratory(folder, name)
    rmse, said = validated(paints, reference(folder))
    np.testing.assert_allclose(rmse, plain, atol=1e-3)
    assert np.sqrt((rmse**2).mean()) == pytest.approx(LABORATORIES[name], abs=6e-4)
    exchanged = [text for text in said if "were exchanged" in text]
    assert len(exchanged) == 1
    assert exchanged[0].startswith(
        "burnt umber thin and burnt umber thick: each agrees with the reference of"
    )


@pytest.mark.real_data
@pytest.mark.parametrize("name", LABORATORIES)
def test_put_right_nothing_is_said(shared_data: Path, name: str) -> None:
    folder = shared_data / "round_robin"
    paints, _ = laboratory(folder, name)
    rmse, said = validated(
        paints.assign_coords(signature=[SAMPLES[1], SAMPLES[0], *SAMPLES[2:]]), reference(folder)
    )
    assert not [text for text in said if "were exchanged" in text]
    assert 0.029 < np.sqrt((rmse**2).mean()) < 0.0435


def test_exchanged_names_are_noticed_and_paints_alike_are_not() -> None:
    nm = np.arange(380.0, 1021.0)
    levels = {"a": 1.0, "b": 1.2, "c": 1.21}
    names = tuple(levels)
    spectra = np.stack([level * seen(NM, 6.0) for level in levels.values()])
    references = field(np.stack([level * seen(nm, 3.0) for level in levels.values()]), names, nm=nm)
    assert not validated(library(spectra, names), references)[1]
    _, said = validated(library(spectra[[1, 0, 2]], names), references)
    assert [text.split(":")[0] for text in said] == ["a and b"]
    # all off alike: whose reference is nearer is chance
    _, said = validated(library(0.9 * spectra[[0, 2, 1]], names), references)
    assert not said
