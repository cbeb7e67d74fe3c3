"""Signatures against references: common bands, pairs, parts, tolerance, and what is said of them."""

import html.parser
import warnings
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.agreeing_spectra import NM, agreeing, field, library, seen, smooth, value_of
from support.refusals import expect_errors, expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError, UnitsError
from hyperpaint.simulation import simulate_line
from hyperpaint.validation.validating import join_detectors

# --- common bands ------------------------------------------------------------------------------------------


def test_two_instruments_that_see_one_paint_agree() -> None:
    found = hp.validate(*agreeing())
    assert found.passed
    assert value_of(found, "rmse") < 1e-5
    # sampled at the centres of the bands, or seen twice as wide, it would not
    assert (
        np.abs(
            np.interp(NM, np.arange(380.0, 1021.0), agreeing()[1]["reflectance"].values[0]) - seen(NM, 6.0)
        ).max()
        > 2e-4
    )
    assert (
        found.statistics["bands"].sel(part="all").item(),
        found.statistics["bands"].sel(part="VIS").item(),
    ) == (NM.size, ((NM >= 400) & (NM < 700)).sum())
    assert found.statistics["coverage"].min() > 0.999


def test_statistics_are_those_of_plain_numpy() -> None:
    signatures, references = agreeing()
    signatures["reflectance"] = signatures["reflectance"] * 1.1 + np.float32(0.01)
    signatures["reflectance"].attrs["units"] = "1"
    found = hp.validate(signatures, references, parts={"red": (600.0, 700.0)}, tolerance=0.001)
    here = (NM >= 600) & (NM < 700)
    s, r = signatures["reflectance"].values[0, here].astype(float), seen(NM, 6.0)[here]
    d = s - r
    expected = {
        "bias": d.mean(), "rmse": np.sqrt((d**2).mean()), "mae": np.abs(d).mean(),
        "spectral_angle": np.degrees(np.arccos((s @ r) / np.linalg.norm(s) / np.linalg.norm(r))),
        "scale": (s @ r) / (r @ r),
    }  # fmt: skip
    for name, wanted in expected.items():
        assert value_of(found, name, "red") == pytest.approx(wanted, rel=1e-3), name
    assert (found.passed, found.problems) == (False, (("hood against hood: red",)))


def test_identical_libraries_agree_wholly() -> None:
    paints = library([smooth(NM), 0.5 * smooth(NM)], ("hood", "roof"))
    found = hp.validate(paints, paints, tolerance=0.0)
    assert found.passed
    assert (found.statistics[["bias", "rmse", "mae", "spectral_angle"]].to_array() == 0).all()
    assert found.statistics["signature"].values.tolist() == ["hood", "roof"]


def test_a_factor_moves_scale_alone() -> None:
    signatures, references = agreeing()
    brighter = signatures.assign(reflectance=(signatures["reflectance"] * 1.25).assign_attrs(units="1"))
    one, other = hp.validate(signatures, references), hp.validate(brighter, references)
    assert (value_of(other, "scale"), value_of(other, "scale_free_error")) == (
        pytest.approx(1.25 * value_of(one, "scale"), rel=1e-6),
        pytest.approx(value_of(one, "scale_free_error"), abs=2e-8),
    )


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
    from math import erf

    np.testing.assert_allclose(
        edge,
        [0.5 * (1 + erf((c - 500.0) / (6.0 / 2.3548) / np.sqrt(2))) for c in NM[(NM > 498) & (NM < 502)]],
        atol=0.03,
    )
    assert np.isnan(spectra["reference"].values[~used]).all()


def test_missing_samples_cost_their_bands_only() -> None:
    signatures, references = agreeing()
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
    with pytest.raises(SchemaError):
        join_detectors(np.array(wavelength))


def test_a_file_may_descend() -> None:
    signatures, references = agreeing()
    turned = references.isel(wavelength=slice(None, None, -1))
    backwards = signatures.isel(band=slice(None, None, -1))
    one, other = hp.validate(signatures, references), hp.validate(backwards, turned)
    assert value_of(one, "rmse") == pytest.approx(value_of(other, "rmse"), abs=1e-12)


def test_units_are_converted_and_wanted() -> None:
    signatures, references = agreeing()
    percent = references.assign(reflectance=(100 * references["reflectance"]).assign_attrs(units="percent"))
    percent = percent.assign_coords(
        wavelength=("wavelength", percent.wavelength.values / 1e3, {"units": "um"})
    )
    assert value_of(hp.validate(signatures, percent, reference_fwhm=3.0), "rmse") < 1e-5
    bare = references.assign(reflectance=references["reflectance"].assign_attrs(units="sr-1"))
    expect_errors((SchemaError, r"reference 1:.*'sr-1'", lambda: hp.validate(signatures, bare)))
    del references["reflectance"].attrs["units"]
    expect_errors((SchemaError, "units-missing", lambda: hp.validate(signatures, references)))


# --- wavelengths that are wrong ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_shift_of_wavelength_shows_in_the_oxygen_residual() -> None:
    line = simulate_line(lines=8, columns=3, smile_nm=0.0, noise=False)
    region = hp.Regions((hp.Region("hood", [(0, 0), (2, 0), (2, 7), (0, 7)]),))
    flat = field(np.full(np.arange(380.0, 1021.0).size, 0.3))
    depths = []
    for shift in (0.0, 0.5):
        moved = line.assign_coords(wavelength=line.wavelength + shift)
        found = hp.validate(hp.extract_signatures(moved, region), flat, tolerance=1.0)
        depths.append(found.statistics["oxygen_residual"].item())
        assert (found.statistics["reference_oxygen_residual"].item(), depths[-1]) == (
            pytest.approx(0.0, abs=1e-9),
            pytest.approx(float(hp.alignment.oxygen_residual(moved).mean()), abs=2e-3),
        )
    assert abs(depths[0]) < 2e-3
    assert depths[1] < -0.02


# --- uncertainty -------------------------------------------------------------------------------------------


def test_uncertainties_of_the_library_are_propagated() -> None:
    nm = np.arange(380.0, 1021.0)
    values = seen(NM, 6.0)
    found = hp.validate(
        library(values, reflectance_u_random=np.full(NM.size, 0.003), reflectance_u_systematic=0.04 * values),
        field(seen(nm, 3.0)),
    )
    expected = np.hypot(0.003 / np.sqrt(NM.size), 0.04 * values.mean())
    assert (value_of(found, "bias_u"), value_of(found, "scale_u")) == (
        pytest.approx(expected, rel=0.08),
        pytest.approx(0.04, rel=0.08),
    )
    assert value_of(found, "spectral_angle_u") < np.degrees(0.02)  # what is common to all bands has no shape
    np.testing.assert_allclose(found.spectra[0]["signature_u"], np.hypot(0.003, 0.04 * values), rtol=0.15)
    assert any("of the reference is unknown" in note for note in found.notes[0])


def test_repeated_readings_tell_their_own_uncertainty() -> None:
    nm = np.arange(380.0, 1021.0)
    levels = np.array([0.97, 1.0, 1.04, 1.01])
    signatures, _ = agreeing()
    found = hp.validate(
        signatures,
        field(np.outer(levels, seen(nm, 3.0)), [f"hood_{n}" for n in range(4)]),
        {"hood": [f"hood_{n}" for n in range(4)]},
    )
    assert (found.statistics.sizes["pair"], value_of(found, "scale"), value_of(found, "scale_u")) == (
        1,
        pytest.approx(1 / levels.mean(), rel=1e-3),
        pytest.approx(levels.std(ddof=1) / 2, rel=0.1),
    )
    np.testing.assert_allclose(
        found.spectra[0]["reference_sd"], levels.std(ddof=1) * seen(NM, 6.0), rtol=1e-3
    )


def test_nothing_known_is_said_so() -> None:
    found = hp.validate(*agreeing())
    assert np.isnan(found.statistics["rmse_u"]).all()
    assert any("signature and the reference is unknown" in note for note in found.notes[0])
    assert "signature_u" not in found.spectra[0]


def test_a_standard_deviation_stands_for_an_unknown_uncertainty() -> None:
    signatures, references = agreeing()
    sd = ("spectrum", "wavelength"), 0.1 * references["reflectance"].values, {"units": "1"}
    counted = references.assign(reflectance_sd=sd, n=("spectrum", [25]))
    assert (
        value_of(hp.validate(signatures, references.assign(reflectance_sd=sd)), "scale_u"),
        value_of(hp.validate(signatures, counted), "scale_u"),
    ) == (pytest.approx(0.1, rel=0.15), pytest.approx(0.02, rel=0.1))


def test_order_of_paints_changes_nothing() -> None:
    values = np.stack([seen(NM, 6.0), 0.5 * seen(NM, 6.0)])
    paints = library(values, ("hood", "roof"), reflectance_u_random=np.full(values.shape, 0.01))
    references = field(np.stack([smooth(np.arange(380.0, 1021.0))] * 2), ("hood", "roof"))
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
        field([smooth(np.arange(380.0, 1021.0))] * 4, ["svc/red_01.sig", "roof.asd.txt", "hood", "other"]),
    )
    pairs = list(zip(found.statistics["signature"].values, found.statistics.reference.values, strict=True))
    assert (pairs, found.unpaired_signatures, found.unpaired_references) == (
        [("hood", "svc/red_01.sig"), ("roof", "roof.asd.txt")],
        (("door (no reference 'nowhere')", "bonnet")),
        (("hood (ASD)", "other (ASD)")),
    )
    for text in ("without a reference: door", "references without a paint: hood"):
        assert text in found.table()


def test_pairs_that_are_said() -> None:
    paints = library([smooth(NM)] * 2, ("hood", "roof"))
    references = field([smooth(np.arange(380.0, 1021.0))] * 2, ["a", "b"])
    found = hp.validate(paints, references, {"roof": "a"})
    assert (found.statistics["signature"].values.tolist(), found.unpaired_signatures) == (
        ["roof"],
        (("hood",)),
    )
    with pytest.raises(SchemaError) as refused:
        hp.validate(paints, references, {"door": "a", "hood": ["a", "c"]})
    assert (refused.value.codes, refused.value.problems[1].expected) == (
        ("paint-unknown", "reference-unknown"),
        "'a', 'b'",
    )
    expect_errors((SchemaError, "reference-unmatched", lambda: hp.validate(paints, references)))
    with pytest.raises(SchemaError, match=r"list.*type-wrong"):
        hp.validate(paints, references, [("hood", "a")])  # type: ignore[arg-type]


def test_instruments_are_compared_apart() -> None:
    signatures, references = agreeing()
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
    paints = library(2.0 * seen(NM, 6.0))
    asd = field(np.outer([0.98, 1.02], seen(np.arange(380.0, 1021.0), 3.0)), ["hood_0", "hood_1"])
    svc = field(1.03 * seen(nm, 3.5), ["hood_s"], nm=nm, fwhm=3.5, instrument="SVC")
    found = hp.validate(paints, [asd, svc], {"hood": ["hood_0", "hood_1", "hood_s"]})
    assert not found.passed
    between = found.between
    assert between is not None
    assert (
        between.statistics["instrument"].values.tolist(),
        between.statistics["signature"].values.tolist(),
    ) == (["ASD against SVC"], ["hood"])
    expected = np.sqrt((((1.0 - 1.03) * seen(nm, 3.5)[((nm >= 400) & (nm < 700))]) ** 2).mean())
    assert (value_of(between, "rmse", "VIS"), value_of(between, "scale"), between.passed) == (
        pytest.approx(expected, rel=2e-3),
        pytest.approx(1 / 1.03, rel=1e-4),
        True,
    )
    text = found.table()
    assert "references against one another" in text
    assert (
        [line.split()[-1] for line in text.splitlines() if "ASD against SVC" in line],
        hp.validate(paints, [svc], {"hood": "hood_s"}).between,
    ) == (["pass"] * 3, None)


# --- what is within the tolerance --------------------------------------------------------------------------


@pytest.mark.parametrize("level", [0.003, 0.008, 0.015, 0.03, 0.06, 0.2, 0.5])
@pytest.mark.parametrize("error", [1.7, 1.0 / 1.7])
def test_seventy_percent_too_high_never_passes(level: float, error: float) -> None:
    # Rationale: an RMSE of 0.02 passed a black that was 70 % too high
    nm = np.arange(380.0, 1021.0)
    paints, truth = library(np.full(NM.size, level * error)), field(np.full(nm.size, level))
    found = hp.validate(paints, truth)
    assert not found.passed
    assert "FAIL" in found.table()
    # the right level passes, unless it is within the floor
    right = hp.validate(library(np.full(NM.size, level)), truth)
    assert right.passed == (level > 0.012)
    if not right.passed:
        assert "too dark for a tolerance of 0.00" in right.problems[0]


@pytest.mark.parametrize("level", [0.02, 0.1, 0.8])
def test_the_limit_is_a_share_of_the_level_and_a_floor(level: float) -> None:
    # Expected: 0.005 + 5 %, just inside passes and just outside fails; other shares as they are said
    truth = field(np.full(np.arange(380.0, 1021.0).size, level))
    for tolerance, limit in ((None, 0.005 + 0.05 * level), ({"relative": 0.1, "floor": 0.0}, 0.1 * level)):
        for share, passes in ((0.99, True), (1.01, False), (-0.99, True), (-1.01, False)):
            found = hp.validate(library(np.full(NM.size, level + share * limit)), truth, tolerance=tolerance)
            assert found.passed is passes
            assert (value_of(found, "rmse_limit"), value_of(found, "level")) == (
                pytest.approx(limit, rel=1e-5),
                pytest.approx(level, rel=1e-5),
            )
    assert hp.validate(library(np.full(NM.size, level + 0.3)), truth, tolerance=0.31).passed


def test_every_row_says_whether_it_passes() -> None:
    rows = [
        line
        for line in hp.validate(
            library([smooth(NM), 1.2 * smooth(NM)], ("hood", "roof")),
            library([smooth(NM)] * 2, ("hood", "roof")),
        )
        .table()
        .splitlines()
        if "/" in line
    ]
    assert (
        [row.split()[-1] for row in rows if row.startswith("hood")],
        [row.split()[-1] for row in rows if row.startswith("roof")],
    ) == (["pass"] * 3, ["FAIL"] * 3)


# --- what is refused, and what is told ---------------------------------------------------------------------


def test_a_panel_scales_what_is_relative() -> None:
    signatures, references = agreeing()
    panel = xr.DataArray(
        [0.9, 0.9],
        {"wavelength": ("wavelength", [300.0, 2500.0], {"units": "nm"})},
        "wavelength",
        attrs={"units": "1"},
    )
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


def test_matched_detectors_are_told() -> None:
    signatures, references = agreeing()
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


def test_mirrored_sky_on_one_side_only_warns() -> None:
    signatures, references = agreeing()
    body = signatures.assign(reflectance=signatures["reflectance"].assign_attrs(mirror_reflection="excluded"))
    whole = references.assign_attrs(mirror_reflection="included")
    with pytest.warns(PaintWarning, match="mirrored-sky-differs") as noted:
        hp.validate(body, whole)
    assert noted[0].filename == __file__  # the line of the caller
    with warnings.catch_warnings():
        warnings.simplefilter("error")
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
        ({"references": xr.Dataset({"radiance": ("x", [1.0])})}, "variable-missing"),
        ({"signatures": xr.Dataset()}, "'reflectance' is missing"),
        ({"signatures": 3}, "type-wrong"),
    ],
)
def test_wrong_calls(change: dict[str, Any], told: str) -> None:
    signatures, references = agreeing()
    call = {"signatures": signatures, "references": references, **change}
    expect_errors(
        (SchemaError, told, lambda: hp.validate(call.pop("signatures"), call.pop("references"), **call))
    )


def test_no_band_in_common() -> None:
    nm = np.arange(1100.0, 1300.0)
    expect_errors(
        (SchemaError, "range-disjoint", lambda: hp.validate(agreeing()[0], field(smooth(nm), nm=nm)))
    )


def test_parts_without_bands_are_not_judged() -> None:
    signatures, references = agreeing()
    found = hp.validate(signatures.isel(band=slice(0, 20)), references)
    assert found.statistics["bands"].sel(part="NIR").item() == 0
    assert np.isnan(value_of(found, "rmse", "NIR"))
    assert found.passed
    assert " NIR " not in found.table()


def test_tolerance_of_several_statistics() -> None:
    signatures, references = agreeing()
    brighter = signatures.assign(reflectance=(signatures["reflectance"] * 1.1).assign_attrs(units="1"))
    assert (
        hp.validate(brighter, references, tolerance={"spectral_angle": 0.06, "scale": 0.11}).passed,
        hp.validate(brighter, references, tolerance={"spectral_angle": 0.06, "scale": 0.09}).passed,
    ) == (True, False)


def test_texts_are_only_texts() -> None:
    paints = library(smooth(NM), (("<b>\x1b[31m$x$\n" + "long " * 20),))
    found = hp.validate(paints, paints.assign_attrs(instrument="<i>"))
    assert "\x1b" not in found.table()
    assert max(map(len, found.table().splitlines()[:4])) < 250
    assert repr(found).startswith("<Validation>")
    page = found._repr_html_()
    assert "<b>" not in page
    assert "<i>" not in page
    html.parser.HTMLParser().feed(page)


def test_dtypes_and_units() -> None:
    table = hp.validate(*agreeing()).statistics
    for name in ("bias", "rmse", "mae", "scale", "scale_free_error", "coverage", "oxygen_residual"):
        assert (table[name].dtype, table[name].attrs["units"]) == (np.float64, "1")
    assert (table["spectral_angle"].attrs["units"], table["bands"].dtype, table["passes"].dtype) == (
        "degree",
        np.int64,
        bool,
    )
    assert all(array.attrs["long_name"] for array in table.data_vars.values())


def test_units_error_of_signatures() -> None:
    signatures, references = agreeing()
    signatures["reflectance"].attrs["units"] = "furlong"
    expect_errors(((SchemaError, UnitsError), "furlong", lambda: hp.validate(signatures, references)))
