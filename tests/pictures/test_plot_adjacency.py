"""A red car reddens a grey one: what is drawn, and whether light says so."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError

pytest.importorskip("matplotlib")

from support.refusals import expect_errors

from hyperpaint.pictures.plot import adjacency_figure

NM = np.linspace(400.0, 1000.0, 31)


def rectangle(name: str, columns: tuple[int, int], lines: tuple[int, int]) -> hp.Region:
    (left, right), (first, last) = columns, lines
    return hp.Region(name, [(left, first), (right, first), (right, last), (left, last)])


NEAR, FAR = rectangle("near", (4, 8), (2, 4)), rectangle("far", (4, 8), (22, 24))


def hood(added: float = 0.04) -> xr.Dataset:
    # Return a grey hood whose first lines are lit by something red, less and less
    red = added * np.exp(-np.arange(30) / 6.0)[:, None] * (NM > 600)
    cube = np.repeat((0.2 + red)[..., None], 12, axis=2).astype(np.float32)
    dims = ("along_track", "band", "cross_track")
    made = xr.Dataset(
        {"reflectance": (dims, cube, {"units": "1"})}, {"wavelength": ("band", NM, {"units": "nm"})}
    )
    layer = np.repeat(red.max(axis=1)[:, None], 12, axis=1).astype(np.float32)
    return made.assign(adjacency=(("along_track", "cross_track"), layer, {"units": "1"}))


def test_curves_are_the_mean_of_their_pixels(tmp_path: Path) -> None:
    line, plain = hood(), hood(0.0)
    _, along, spectra, added = adjacency_figure(
        line.chunk(along_track=7), NEAR, FAR, tmp_path / "a.png", without=plain, width=3
    ).axes
    assert (tmp_path / "a.png").stat().st_size > 10_000
    distance, values = along.lines[2].get_data()  # 650 nm
    np.testing.assert_array_equal(distance, np.arange(21))
    expected = 0.2 + 0.04 * np.exp(-(3 + np.arange(21)) / 6.0)
    np.testing.assert_allclose(values, expected, rtol=1e-5)
    np.testing.assert_allclose(along.lines[0].get_ydata(), 0.2, rtol=1e-5)  # 450 nm
    np.testing.assert_allclose(along.lines[6].get_ydata(), 0.2, rtol=1e-5)  # 650 nm, without
    np.testing.assert_allclose(added.lines[2].get_ydata(), expected - 0.2, atol=1e-6)
    np.testing.assert_allclose(added.lines[-1].get_ydata(), expected - 0.2, atol=1e-6)  # as flagged
    near = spectra.lines[0].get_ydata()
    np.testing.assert_allclose(
        near[NM > 600], 0.2 + 0.04 * np.exp(-np.array([2, 3, 4]) / 6).mean(), rtol=1e-5
    )
    np.testing.assert_allclose(near[NM < 600], 0.2, rtol=1e-5)
    labels = [text.get_text() for text in spectra.get_legend().get_texts()]
    assert labels == ["near", "far", "without the neighbour's colour"]


def test_without_anything_to_compare_with() -> None:
    _, along, _, added = adjacency_figure(hood().drop_vars("adjacency"), NEAR, FAR).axes
    assert not added.axison
    assert along.get_xlabel() == "distance from the near end [pixel]"
    slanted = adjacency_figure(hood(), NEAR, rectangle("far", (0, 2), (20, 22)), wavelengths=(450, 650))
    assert slanted.axes[1].lines[0].get_xdata().size == int(np.hypot(18, 5)) + 1


def test_bands_and_pixels_that_are_missing() -> None:
    line = hood()
    line["reflectance"][:, 4] = np.nan
    line["reflectance"][3, :, 6] = np.nan
    near = adjacency_figure(line, NEAR, FAR).axes[2].lines[0].get_ydata()
    assert np.isnan(near[4])
    assert np.isfinite(np.delete(near, 4)).all()


def test_what_cannot_be_drawn() -> None:
    line = hood()
    with pytest.raises(SchemaError) as refused:
        adjacency_figure(line, NEAR, hp.Regions((NEAR, FAR)), without=line.isel(band=slice(5)), width=0)
    assert refused.value.codes == ("grid-mismatch", "value-out-of-range", "region-number")
    expect_errors(
        (
            SchemaError,
            r"'off'.*region-empty",
            lambda: adjacency_figure(line, NEAR, rectangle("off", (40, 50), (2, 4))),
        ),
        (
            SchemaError,
            "region-overlap",
            lambda: adjacency_figure(line, NEAR, rectangle("same", (4, 8), (2, 4))),
        ),
        (
            SchemaError,
            "'reflectance' is missing",
            lambda: adjacency_figure(line.drop_vars("reflectance"), NEAR, FAR),
        ),
    )


def test_scenes_stand_above_the_spectra_of_their_regions() -> None:
    scenes = {"noon": hood(), "cloudy": 0.5 * hood(0.0)}
    for scene in scenes.values():
        scene.reflectance.attrs["units"] = "1"
    draw = partial(hp.pictures.scenes_and_spectra, scenes, variable="reflectance")
    *_, spectra = draw([NEAR, FAR]).axes[:2]
    assert [line.get_linestyle() for line in spectra.lines[:2]] == ["-", "-"]
    apart = draw({"noon": [NEAR], "cloudy": [FAR]}, together=False).axes
    assert len(apart) == 4
    np.testing.assert_allclose(apart[3].lines[0].get_ydata(), 0.1, rtol=1e-5)
    expect_errors(
        (SchemaError, "value-out-of-range", lambda: hp.pictures.scenes_and_spectra({}, [NEAR])),
        (SchemaError, "region-empty", lambda: draw([rectangle("off", (40, 50), (2, 4))])),
    )
