"""Paints looked for in an image: scores against plain numpy and SPy, rates, refusals, the same bits."""

from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from support.refusals import expect_error, expect_words, refusal

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.cli.program import main
from hyperpaint.paints import detection as false_alarms
from hyperpaint.paints.detection import distances, projection, scores
from hyperpaint.regions import Region, Regions

NM = np.linspace(405.0, 995.0, 30)
RED, GREEN = "Synthetic Signal Red", "Synthetic Alpine Green"
CUBE = ("along_track", "band", "cross_track")


@pytest.fixture(scope="module")
def paints() -> xr.Dataset:
    return hp.paints.starter_library(members=4, wavelength=NM)


@pytest.fixture(scope="module")
def red(paints: xr.Dataset) -> xr.Dataset:
    return paints.isel(signature=[list(paints["signature"].values).index(RED)])


def make_line(
    library: xr.Dataset | None = None, *, lines: int = 96, columns: int = 40, seed: int = 3
) -> xr.Dataset:
    # Return asphalt and grass with noise; of a library, each paint on 6 x 6 pixels under mirrored sky
    rng = np.random.default_rng(seed)
    asphalt, grass = 0.08 + 5e-5 * (NM - 400.0), 0.05 + 0.4 / (1.0 + np.exp((715.0 - NM) / 12.0))
    share = rng.beta(0.5, 2.0, (lines, 1, columns))
    seen = (asphalt[:, None] * (1.0 - share) + grass[:, None] * share) * rng.normal(
        1.0, 0.2, (lines, 1, columns)
    )
    for number, spectrum in enumerate(() if library is None else library["reflectance"].values):
        level = rng.uniform(0.7, 1.1, (6, 1, 6))
        sky = 0.02 * (NM / 550.0) ** -3
        row = 10 + 20 * number
        seen[row : row + 6, :, 8:14] = level * spectrum[:, None] + sky[:, None]
    seen *= rng.normal(1.0, 0.01, seen.shape)
    quality = np.zeros((lines, columns), np.uint16)
    return xr.Dataset(
        {
            "reflectance": (CUBE, seen.astype(np.float32), {"units": "1"}),
            "quality": (CUBE[::2], quality),
        },
        {"wavelength": ("band", NM, {"units": "nm"})},
    )


def spectra_of(line: xr.Dataset) -> np.ndarray:
    return np.moveaxis(line["reflectance"].values.astype(float), 1, 2).reshape(-1, NM.size)


# --- scores ------------------------------------------------------------------------------------------------


def some_spectra(seed: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    spectra = rng.random((200, 9)) @ rng.random((9, 9)) + 0.1
    return spectra, rng.random((3, 9)), spectra.mean(axis=0), np.cov(spectra.T)


def test_scores_are_those_of_plain_numpy_at_any_scale() -> None:
    spectra, paints, mean, covariance = some_spectra()
    inverse = np.linalg.inv(covariance)
    project = projection(paints, None, mean, covariance)
    ace, matched = (scores(spectra, project, method) for method in ("ace", "matched_filter"))
    angle = scores(spectra, projection(paints, None), "spectral_angle")
    for n, pixel in enumerate(spectra):
        for k, paint in enumerate(paints):
            x, t = pixel - mean, paint - mean
            product = t @ inverse @ x
            expected = product**2 / ((t @ inverse @ t) * (x @ inverse @ x)) * np.sign(product)
            assert ace[n, k] == pytest.approx(expected, rel=1e-9, abs=1e-12)
            assert matched[n, k] == pytest.approx(product / (t @ inverse @ t), rel=1e-9, abs=1e-12)
            cosine = pixel @ paint / np.sqrt((pixel @ pixel) * (paint @ paint))
            assert angle[n, k] == pytest.approx(cosine, rel=1e-12)
    plain = scores(spectra, projection(paints, None, mean, covariance), "ace")
    longer = scores(mean + 3.7 * (spectra - mean), projection(paints, None, mean, covariance), "ace")
    np.testing.assert_allclose(longer, plain, rtol=1e-9)
    rng = np.random.default_rng(8)
    change, shift = rng.random((9, 9)) + np.eye(9), rng.random(9)
    moved = projection(paints @ change + shift, None, mean @ change + shift, change.T @ covariance @ change)
    np.testing.assert_allclose(scores(spectra @ change + shift, moved, "ace"), plain, rtol=1e-6, atol=1e-9)


def test_scores_are_those_of_spy() -> None:
    spectral = pytest.importorskip("spectral")
    spectra, paints, mean, covariance = some_spectra()
    background = spectral.GaussianStats(mean=mean, cov=covariance, nsamples=len(spectra))
    project = projection(paints, None, mean, covariance)
    image = spectra.reshape(20, 10, -1)
    for number, paint in enumerate(paints):
        ace = spectral.ace(image, paint, background=background).ravel()
        matched = spectral.matched_filter(image, paint, background=background).ravel()
        np.testing.assert_allclose(np.abs(scores(spectra, project, "ace"))[:, number], ace, atol=1e-9)
        np.testing.assert_allclose(scores(spectra, project, "matched_filter")[:, number], matched, rtol=1e-7)


@pytest.mark.parametrize("method", ["ace", "matched_filter", "spectral_angle"])
def test_mirrored_sky_changes_no_product_with_a_paint(method: str) -> None:
    spectra, paints, mean, covariance = some_spectra()
    sky = np.linspace(1.0, 0.2, 9)
    known = () if method == "spectral_angle" else (mean, covariance)
    project = projection(paints, sky, *known)
    more = scores(spectra + 0.3 * sky, project, method)
    np.testing.assert_allclose(more, scores(spectra, project, method), atol=1e-9)


def test_distances_are_those_of_least_squares() -> None:
    spectra, paints, *_ = some_spectra()
    sky = np.linspace(1.0, 0.2, 9)
    distance, level = distances(spectra, paints, sky)
    for n in range(0, 200, 20):
        for k, paint in enumerate(paints):
            amounts, *_ = np.linalg.lstsq(np.stack([paint, sky], axis=1), spectra[n], rcond=None)
            rest = spectra[n] - amounts[0] * paint - amounts[1] * sky
            assert level[n, k] == pytest.approx(amounts[0])
            expected = np.linalg.norm(rest) / np.linalg.norm(amounts[0] * paint) if amounts[0] > 0 else np.inf
            assert distance[n, k] == pytest.approx(expected, rel=1e-6)


# --- detections --------------------------------------------------------------------------------------------


def test_paints_are_detected_where_they_are(paints: xr.Dataset, red: xr.Dataset) -> None:
    line = make_line(red)
    found = hp.paints.detect(line, red, false_alarm_rate=1e-2, sky=(NM / 550.0) ** -3).compute()
    detected = found["detected"].values
    assert detected[10:16, 8:14].mean() > 0.9
    detected[10:16, 8:14] = False
    assert not detected.any()
    assert found["best_paint"].attrs["flag_meanings"] == "none Synthetic_Signal_Red"
    level = found["paint_level"].values[10:16, 8:14]
    assert level.min() > 0.65
    assert level.max() < 1.2
    twin = red.assign_coords(signature=["twin"])
    found = hp.paints.detect(line, red, false_alarm_rate=1e-2, others=twin).compute()
    assert found["distance_limit"].item() == 0.0
    assert not found["detected"].any()
    clear = np.ones((96, 40), bool)
    clear[10:16, 8:14] = False
    found = hp.paints.detect(line, red, false_alarm_rate=1e-2, background=clear, sky=None).compute()
    assert found["detected"].values[10:16, 8:14].any()
    turned = xr.DataArray(clear, dims=("lines", "samples")).T
    options: dict[str, Any] = {"false_alarm_rate": 1e-2, "sky": None}
    xr.testing.assert_identical(found, hp.paints.detect(line, red, background=turned, **options).compute())


def test_paints_that_are_not_looked_for_are_rejected(paints: xr.Dataset, red: xr.Dataset) -> None:
    other = paints.isel(
        signature=[number for number in range(40) if paints["signature"].values[number] != RED][::9]
    )
    line = make_line(other, lines=160)
    found = hp.paints.detect(line, red, false_alarm_rate=1e-2, sky=(NM / 550.0) ** -3).compute()
    assert not found["detected"].any()
    freely = hp.paints.detect(line, red, false_alarm_rate=1e-2, unknown_rate=1.0, sky=(NM / 550.0) ** -3)
    assert freely["detected"].values.any()


@pytest.mark.parametrize("method", ["ace", "matched_filter", "spectral_angle"])
@pytest.mark.parametrize("rate", [1e-2, 1e-3])
def test_rate_is_that_of_the_background(paints: xr.Dataset, method: str, rate: float) -> None:
    some = paints.isel(signature=[5, 15, 25])
    line = make_line(lines=320, columns=64)
    found = hp.paints.detect(
        line, some, method=method, false_alarm_rate=rate, unknown_rate=1.0, sky=None
    ).compute()
    # without targets and rejection, what is detected is what is above a threshold and at a level
    claimed = rate * line["quality"].size
    x = spectra_of(line)
    known = () if method == "spectral_angle" else (x.mean(axis=0), np.cov(x.T))
    values = scores(x, projection(some["reflectance"].values.astype(float), None, *known), method)
    above = (values >= found["score_threshold"].values * (1.0 - 1e-9)).any(axis=1).sum()
    assert 0.8 * claimed - 3 <= above <= claimed + 1
    assert found["detected"].sum() <= above
    assert abs(found["checked_rate"].item() - rate) < 3 * found["checked_rate_u"].item()


def test_rate_of_others_is_that_of_the_limits(paints: xr.Dataset) -> None:
    rng = np.random.default_rng(11)
    looked_for = paints["reflectance"].values[[3, 8, 30]].astype(float)
    others = looked_for[rng.integers(0, 3, 4000)] * rng.normal(1.0, 0.3, (4000, NM.size))
    apart = distances(others, looked_for, None)
    for rate in (1e-1, 1e-2):
        limit = false_alarms.distance_limits(apart, rate)
        share = (apart[0] <= limit).any(axis=1).mean()
        assert 0.9 * rate <= share <= rate * 4001 / 4000


def test_flagged_pixels_are_no_background_and_not_detected(red: xr.Dataset) -> None:
    line = make_line(red)
    line["reflectance"].values[:20, :, 30:] = 5.0
    line["quality"].values[:20, 30:] = int(hp.Quality.SATURATED)
    line["quality"].values[10:16, 8:11] = int(hp.Quality.GLINT)
    options = {"false_alarm_rate": 1e-2, "sky": (NM / 550.0) ** -3}
    found = hp.paints.detect(line, red, **options).compute()
    assert not found["detected"].values[10:16, 8:11].any()
    assert found["detected"].values[10:16, 11:14].mean() > 0.9
    line["reflectance"].values[:20, :, 30:] = np.nan
    again = hp.paints.detect(line, red, **options).compute()
    assert again["score_threshold"].item() == found["score_threshold"].item()
    assert (again["best_paint"].values[:20, 30:] == -1).all()
    keeping = hp.paints.detect(line, red, exclude=hp.Quality.SATURATED, **options).compute()
    assert keeping["detected"].values[10:16, 8:11].any()


def test_rate_says_nothing_of_what_is_like_a_paint(red: xr.Dataset) -> None:
    line = make_line(lines=160, columns=64)
    spectrum = red["reflectance"].values[0].astype(float)
    ripple = np.sin(NM / 60.0)
    ripple -= spectrum * (ripple @ spectrum) / (spectrum @ spectrum)
    like = spectrum + ripple / np.linalg.norm(ripple) * 0.04 * np.linalg.norm(spectrum)  # never the paint
    rng = np.random.default_rng(5)
    noise = rng.normal(1.0, 0.005, (30, NM.size, 64))
    line["reflectance"].values[:30] = like[:, None] * rng.uniform(0.7, 1.1, (30, 1, 64)) * noise
    options = {"method": "spectral_angle", "false_alarm_rate": 1e-3, "sky": None}
    with pytest.warns(PaintWarning, match=r"19 % .*resembles-paints"):
        alarms = hp.paints.detect(line, red, **options).compute()
    assert alarms["explained_share"].item() == pytest.approx(30 / 160, abs=0.01)
    assert alarms["detected"].values[:30].mean() > 0.5  # what the warning is for
    assert alarms["checked_rate"].item() < 2e-3
    judged = hp.paints.detect(line, red, background=np.ones((160, 64), bool), **options).compute()
    assert judged["explained_share"].item() == 0.0
    assert judged["detected"].values.mean() <= 1e-3


@pytest.mark.parametrize("method", ["ace", "spectral_angle"])
def test_a_pixel_of_zeros(red: xr.Dataset, method: str) -> None:
    line = make_line(red)
    line["reflectance"].values[50, :, 20] = 0.0
    detections = hp.paints.detect(line, red, method=method, false_alarm_rate=1e-2, sky=None).compute()
    assert np.isfinite(detections["detection_score"]).all()
    assert detections["detected"].values[10:16, 8:14].any()
    assert not detections["detected"].values[50, 20]


def test_same_bits_whatever_the_chunks(red: xr.Dataset) -> None:
    line = make_line(red)
    whole = line.paint.detect(red, false_alarm_rate=1e-2).compute(scheduler="sync")
    for chunks in (
        {"along_track": 1}, {"along_track": 7, "band": 4}, {"along_track": 50, "cross_track": 9},
        {"along_track": 96}, {"along_track": 33},
    ):  # fmt: skip
        chunked = line.chunk(chunks).paint.detect(red, false_alarm_rate=1e-2).compute(scheduler="threads")
        xr.testing.assert_identical(whole, chunked)


def test_nothing_is_computed_before_it_is_asked_for(red: xr.Dataset) -> None:
    def refused(*_: Any, **__: Any) -> None:
        raise AssertionError("something was computed")

    line = make_line(red)
    line["reflectance"] = line["reflectance"].chunk(along_track=16)  # wavelengths are read
    with dask.config.set(scheduler=refused):
        found = hp.paints.detect(line, red)
    for name, dtype, units in (
        ("detection_score", "float32", "1"), ("best_paint", "int16", None), ("detected", "bool", None),
        ("paint_distance", "float32", "1"), ("score_threshold", "float64", "1"),
    ):  # fmt: skip
        assert found[name].chunks is not None or found[name].ndim == 0
        assert (found[name].dtype, found[name].attrs.get("units")) == (dtype, units)
        assert found[name].attrs["long_name"]
    theirs = line.rename(along_track="downtrack", cross_track="crosstrack", band="bands")
    found = theirs.paint.detect(red, false_alarm_rate=1e-2)
    ours = line.paint.detect(red, false_alarm_rate=1e-2)
    np.testing.assert_array_equal(found["detected"].values, ours["detected"].values)


# --- refusals ----------------------------------------------------------------------------------------------


def test_refusals(paints: xr.Dataset, red: xr.Dataset) -> None:
    line = make_line(red)
    wrong: dict[str, Any] = {"method": "x", "false_alarm_rate": 0.0, "unknown_rate": 2.0, "shrinkage": -1.0}
    error = expect_error(SchemaError, "choice-unknown", lambda: hp.paints.detect(line, red, **wrong))
    expect_words(str(error), *wrong)
    far = red.assign_coords(wavelength=red["wavelength"] + 2000.0)
    flat = line.assign(reflectance=line["reflectance"].isel(band=[0]).isel(band=[0] * 30))
    columns = xr.DataArray(np.arange(40), dims="cross_track")
    mask = xr.DataArray(
        np.ones((96, 40), bool), {"cross_track": columns[::-1]}, ("along_track", "cross_track")
    )
    calls: dict[str, tuple[xr.Dataset, xr.Dataset, dict[str, Any]]] = {
        "bands-not-shared": (line, far, {}),
        "other-paints-missing": (line, red, {"others": red}),
        "length-mismatch": (line, red, {"sky": np.ones(3)}),
        "background-too-small": (line.isel(along_track=[0], cross_track=slice(20)), red, {}),
        "background-empty": (line.assign(quality=line["quality"] | 1), red, {}),
        "false-alarm-rate-too-low": (line, red, {"false_alarm_rate": 1e-5}),
        "covariance-singular": (flat, red, {"false_alarm_rate": 1e-2}),
        "grid-mismatch": (line, red, {"background": np.ones((95, 40), bool)}),
        "labels 'cross_track'": (line.assign_coords(cross_track=columns), red, {"background": mask}),
        "dims-wrong": (line, red, {"background": xr.DataArray(np.ones((96, 40), bool), dims=("paint", "b"))}),
    }
    for code, (searched, library, options) in calls.items():
        with pytest.raises(SchemaError, match=code):
            hp.paints.detect(searched, library, **options).compute()


# --- regions -----------------------------------------------------------------------------------------------


def test_regions_with_and_without_a_paint_and_of_another_line(red: xr.Dataset) -> None:
    found = make_line(red).paint.detect(red, false_alarm_rate=1e-2, sky=(NM / 550.0) ** -3)
    outlines = {"car": (8, 10), "road": (22, 40)}
    regions = Regions(
        tuple(
            Region(name, [(x, y), (x + 5, y), (x + 5, y + 5), (x, y + 5)])
            for name, (x, y) in outlines.items()
        )
    )
    cars = hp.paints.detected_regions(found, regions)
    assert (cars["signature"].values.tolist(), cars["pixels"].values.tolist()) == ([RED, ""], [36, 36])
    placements = cars["placements"].values
    assert placements[0] > 60
    assert cars["p_value"].values[0] == pytest.approx(1 / (placements[0] + 1))
    assert cars["p_value"].values[1] == 1.0
    expect_error(
        SchemaError,
        r"'off'.*region-empty",
        lambda: hp.paints.detected_regions(found, Regions((Region("off", [(90, 0), (99, 0), (99, 9)]),))),
    )
    # of another line
    detections = hp.paints.detect(make_line(red).assign_attrs(name="raw_0"), red, false_alarm_rate=1e-2)
    corners = [(8, 10), (13, 10), (13, 15), (8, 15)]
    own = hp.paints.detected_regions(detections, [Region("car", corners, flightline="raw_0")])
    assert own["signature"].item() == RED
    expect_error(
        SchemaError,
        "flightline-unknown",
        lambda: hp.paints.detected_regions(detections, [Region("car", corners, flightline="raw_1")]),
    )


def test_background_may_be_regions_and_per_cent_is_told(red: xr.Dataset) -> None:
    line = make_line(red)
    road = Regions((Region("road", [(0, 30), (60, 30), (60, 60), (0, 60)]),))
    options = {"false_alarm_rate": 1e-2, "sky": (NM / 550.0) ** -3}
    found = [
        line.paint.detect(red, background=background, **options)
        for background in (road, hp.regions.region_mask(road, line) >= 0)
    ]
    xr.testing.assert_equal(*found)
    library = red.assign(reflectance=(100.0 * red.reflectance).assign_attrs(units="1"))
    with pytest.warns(hp.errors.PaintWarning, match="scale-doubtful"):
        line.paint.detect(library.swap_dims(band="wavelength"), **options)


def test_p_values_know_that_the_paint_was_chosen() -> None:
    p_values = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        shown = np.full((66, 66), -1)
        for top, left in rng.integers(0, 63, (120, 2)):  # blobs of any of 20 paints, none of which is there
            shown[top : top + 4, left : left + 4] = rng.integers(20)
        pixels = ("along_track", "cross_track")
        detections = xr.Dataset(
            {"detected": (pixels, shown >= 0), "best_paint": (pixels, np.maximum(shown, 0).astype(np.int16))},
            {"signature": [f"paint {number}" for number in range(20)]},
        )
        car = Region("car", [(29.5, 29.5), (35.5, 29.5), (35.5, 35.5), (29.5, 35.5)])
        p_values.append(hp.paints.detected_regions(detections, [car])["p_value"].item())
    assert np.mean(np.array(p_values) <= 0.05) < 0.08


# --- pictures and the command ------------------------------------------------------------------------------


def test_curve_of_detections(red: xr.Dataset, tmp_path: Any) -> None:
    pytest.importorskip("matplotlib")
    line = make_line(red)
    truth = np.zeros((96, 40), bool)
    truth[10:16, 8:14] = True
    named = {
        method: line.paint.detect(red, method=method, false_alarm_rate=1e-2)
        for method in ("ace", "spectral_angle")
    }
    figure = hp.pictures.detection_curve(named, truth, tmp_path / "roc.png")
    assert (tmp_path / "roc.png").stat().st_size > 1000
    alarms, hits = figure.axes[0].lines[0].get_data()
    assert (np.diff(alarms) >= 0).all()
    assert (np.diff(hits) >= 0).all()
    assert hits[-1] == alarms[-1] == 1.0
    score = named["ace"]["detection_score"].values
    better = (score[truth][:, None] > score[~truth]).mean()
    assert np.trapezoid(hits, alarms) == pytest.approx(better, abs=0.01)
    with refusal(SchemaError, "truth-uniform", "False everywhere"):
        hp.pictures.detection_curve(named, np.zeros((96, 40), bool))


def test_command_takes_regions_of_its_line_alone(red: xr.Dataset, tmp_path: Any) -> None:
    hp.to_store(make_line(red).assign_attrs(name="raw_0"), tmp_path / "line.zarr")
    hp.write_library(red, tmp_path / "red.zarr")
    corners = [(8, 10), (13, 10), (13, 15), (8, 15)]
    cars = (Region("car", corners, flightline="raw_0"), Region("lorry", corners, flightline="raw_1"))
    hp.write_regions(Regions(cars), tmp_path / "cars.geojson")
    road = Region("road", [(-0.5, 29.5), (39.5, 29.5), (39.5, 95.5), (-0.5, 95.5)])
    hp.write_regions(Regions((road,)), tmp_path / "road.geojson")
    result = CliRunner().invoke(
        main,
        ["detect", str(tmp_path / "line.zarr"), "--library", str(tmp_path / "red.zarr"),
         "--false-alarm-rate", "0.01",
         "--regions", str(tmp_path / "cars.geojson"), "--background", str(tmp_path / "road.geojson"),
         "--out", str(tmp_path / "detections.zarr"), "--quiet"],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "1 of 2 regions are of other flight lines" in result.output
    assert f"{RED}  " in result.output
    assert "car" in result.output.splitlines()[-1]
    assert "because a paint explains them: 0 of the pixels" in result.output
    clear = np.zeros((96, 40), bool)
    clear[30:] = True
    ours = make_line(red).paint.detect(red, false_alarm_rate=0.01, background=clear)
    with xr.open_zarr(tmp_path / "detections.zarr") as detections:
        np.testing.assert_array_equal(detections["detected"].values, ours["detected"].values)
