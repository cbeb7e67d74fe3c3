"""Units of strangers: however a unit is written, and whatever registry it is of, it counts or is refused."""

import datetime
import inspect
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rioxarray  # noqa: F401  (the accessor rio)
import xarray as xr
from support.refusals import expect_error, expect_refusals
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import PaintError, UnitsError
from hyperpaint.base.facts import conversion_factor, in_units, plain, quantify, takes_quantities
from hyperpaint.radiometry.pixel_reading import worked_example

pint = pytest.importorskip("pint")


class Registry(pint.LazyRegistry):  # type: ignore[misc]
    # A registry takes a second; it is read on first use, which is not when pytest looks for tests
    __test__ = False
    _mock_name = ""


FIRST = Registry(kwargs={"force_ndarray_like": True})
SECOND = Registry(kwargs={"autoconvert_offset_to_baseunit": True})


def array(values: Any, unit: str | None = None) -> xr.DataArray:
    return xr.DataArray(values, attrs={} if unit is None else {"units": unit})


#: The same 550 nm, as forty strangers would hand it over; None where it must be refused.
WAVELENGTHS: dict[str, tuple[Callable[[], Any], float | None]] = {
    "a number": (lambda: 550.0, 550.0),
    "an integer": (lambda: 550, 550.0),
    "numpy's number": (lambda: np.float32(550.0), 550.0),
    "a 0-d array": (lambda: np.array(550.0), 550.0),
    "a Quantity": (lambda: 0.55 * FIRST.um, 550.0),
    "another registry": (lambda: 0.55 * SECOND.micrometer, 550.0),
    "application registry": (lambda: pint.get_application_registry().Quantity(5500.0, "angstrom"), 550.0),
    "no registry": (lambda: pint.Quantity(0.55, "micron"), 550.0),
    "an integer Quantity": (lambda: SECOND.Quantity(550, "nm"), 550.0),
    "a 0-d Quantity": (lambda: FIRST.Quantity(np.array(550.0), "nm"), 550.0),
    "inches": (lambda: FIRST.Quantity(550e-9 / 0.0254, "inch"), 550.0),
    "a DataArray, nm": (lambda: array(550.0, "nm"), 550.0),
    "a DataArray, um": (lambda: array(0.55, "um"), 550.0),
    "a DataArray, ENVI": (lambda: array(0.55, "Micrometers"), 550.0),
    "a DataArray, scale": (lambda: array(55.0, "10 nm"), 550.0),
    "a DataArray, Å": (lambda: array(5500.0, "Å"), 550.0),
    "a DataArray of Quantities": (lambda: xr.DataArray(FIRST.Quantity(np.array(0.55), "um")), 550.0),
    "Quantities against attributes": (
        lambda: xr.DataArray(FIRST.Quantity(np.array(0.55), "um"), attrs={"units": "nm"}), 550.0,
    ),
    "a list of Quantities": (lambda: [0.55 * FIRST.um], 550.0),
    "a tuple of two registries": (lambda: (0.55 * FIRST.um, 550 * SECOND.nm), 550.0),
    "a list and a number": (lambda: [0.55 * FIRST.um, 550.0], 550.0),
    "an array Quantity": (lambda: SECOND.Quantity(np.array([0.55, 0.55]), "um"), 550.0),
    "a DataArray without units": (lambda: array(550.0), None),
    "a second": (lambda: 0.55 * FIRST.s, None),
    "a frequency": (lambda: SECOND.Quantity(545.0, "THz"), None),
    "a wavenumber": (lambda: FIRST.Quantity(18182.0, "1/cm"), None),
    "a photon's energy": (lambda: FIRST.Quantity(2.25, "eV"), None),
    "a dimensionless Quantity": (lambda: FIRST.Quantity(550.0, ""), None),
    "a count": (lambda: FIRST.Quantity(550.0, "count"), None),
    "a temperature": (lambda: SECOND.Quantity(550.0, "degC"), None),
    "a decibel": (lambda: FIRST.Quantity(550.0, "dB"), None),
    "a root": (lambda: FIRST.Quantity(550.0, "nm**0.5"), None),
    "a unit alone": (lambda: FIRST.um, None),
    "text": (lambda: "550", None),
    "text with a unit": (lambda: "0.55 um", None),
    "a DataArray, seconds": (lambda: array(550.0, "s"), None),
    "a DataArray, nonsense": (lambda: array(550.0, "furlong"), None),
    "a DataArray, a time axis": (lambda: array(550.0, "days since 1970-01-01"), None),
    "a DataArray, no text": (lambda: array(550.0).assign_attrs(units=5), None),
    "a duration": (lambda: np.timedelta64(550, "ns"), None),
    "a list of a wrong one": (lambda: [550 * FIRST.nm, 550 * FIRST.s], None),
}  # fmt: skip


@pytest.mark.parametrize("name", WAVELENGTHS)
def test_a_wavelength_counts_by_its_unit_or_is_refused(name: str) -> None:
    value, expected = WAVELENGTHS[name]
    line = worked_example()
    if expected is None:
        expect_error(UnitsError, "wavelength", lambda: line.paint.at(value()))
    else:
        np.testing.assert_array_equal(np.unique(line.paint.at(value()).wavelength), [expected])


#: Spellings of one watt per square metre and nanometre, by their factor; None where they must be refused.
IRRADIANCES = {
    "W m-2 nm-1": 1.0, "W/m2/nm": 1.0, "W/m^2/nm": 1.0, "W/m**2/nm": 1.0, "W.m-2.nm-1": 1.0,
    "W m^-2 nm^-1": 1.0, "W·m⁻²·nm⁻¹": 1.0, "W / (m2 nm)": 1.0, "W/(m^2*nm)": 1.0,
    "watt/meter**2/nanometer": 1.0,
    "watt / meter ** 2 / nanometer": 1.0, "kg s-3 nm-1": 1.0, "J s-1 m-2 nm-1": 1.0, "mW m-2 nm-1": 1e-3,
    "uW cm-2 nm-1": 1e-2, "µW cm⁻² nm⁻¹": 1e-2, "μW/cm²/nm": 1e-2, "microwatt cm-2 nm-1": 1e-2,
    "W m-2 um-1": 1e-3, "W m-2 micron-1": 1e-3, "mW/m²/µm": 1e-6, "1e-3 W m-2 nm-1": 1e-3,
    "1.e-3 W m-2 nm-1": 1e-3,
    "W m-2 angstrom-1": 10.0, "W m-3": 1e-9,
    "W m-2 sr-1 nm-1": None, "W m-2": None, "W": None, "count": None, "1": None, "": None,
    "photons s-1 nm-1": None,
    "Watts per square metre": None, "W m-2 nm-1 ?": None, "lux": None, "None": None, "nan": None,
}  # fmt: skip


@pytest.mark.parametrize("text", IRRADIANCES)
def test_an_irradiance_counts_by_its_text_or_is_refused(text: str) -> None:
    line, factor = worked_example(), IRRADIANCES[text]
    other = line.copy()
    other["irradiance"] = (line.irradiance / (factor or 1.0)).assign_attrs(units=text)
    if factor is None:
        expect_refusals(
            (PaintError, "units-not-convertible", "'irradiance'", lambda: other.paint.reflectance())
        )
    else:
        np.testing.assert_allclose(
            other.paint.reflectance().reflectance, line.paint.reflectance().reflectance, rtol=2.4e-7
        )


def in_registry(line: xr.Dataset, units: Any, irradiance: str, gain: str, exposure: str) -> xr.Dataset:
    # Return the line with float64 Quantities in other units, and attributes that say the old ones still
    other = line.copy()
    for name, unit in (("irradiance", irradiance), ("radiance_gain", gain), ("exposure_time", exposure)):
        old = line[name].attrs["units"]
        values = line[name].values.astype(np.float64) / conversion_factor(unit, old)
        other[name] = (line[name].dims, units.Quantity(values, units.Unit(unit_of(unit))), {"units": old})
    other["counts"] = (line.counts.dims, units.Quantity(line.counts.values, "count"), {})
    return other


def unit_of(text: str) -> str:
    return " * ".join(
        f"{part.rstrip('-0123456789')}**{part[len(part.rstrip('-0123456789')) :] or 1}"
        for part in text.split()
    )


def test_three_registries_give_one_reflectance() -> None:
    line = worked_example()
    truth = line.paint.reflectance().reflectance.values
    np.testing.assert_allclose(truth[:, 1], 0.4, rtol=1e-6)
    for units, names in (
        (FIRST, ("mW m-2 nm-1", "mW m-2 sr-1 nm-1 s count-1", "ms")),
        (SECOND, ("uW cm-2 nm-1", "uW cm-2 sr-1 um-1 ms count-1", "us")),
        (pint.get_application_registry(), ("W m-2 um-1", "W cm-2 sr-1 nm-1 s count-1", "min")),
    ):
        other = in_registry(line, units, *names)
        held = {name: variable._data for name, variable in other.variables.items()}
        for made in (other.paint.reflectance(), hp.reflectance(other)):
            np.testing.assert_allclose(made.reflectance.values, truth, rtol=1e-7, atol=0)
            assert not any(hasattr(variable._data, "magnitude") for variable in made.variables.values())
        assert all(held[name] is variable._data for name, variable in other.variables.items())


def test_a_view_in_quantities_goes_through_the_chain_like_the_line() -> None:
    pytest.importorskip("pint_xarray")
    line = flight(lines=8, columns=4).line
    view = line.paint.quantify()
    assert hasattr(view.irradiance.data, "magnitude")
    for of in (
        lambda ds: ds.paint.radiance().radiance,
        lambda ds: ds.paint.reflectance().reflectance,
        lambda ds: hp.reflectance(ds, ds[["irradiance", "irradiance_fwhm"]]).reflectance,
        lambda ds: hp.radiometry.smooth(ds.paint.reflectance().paint.quantify(), window=5).reflectance,
        lambda ds: ds.paint.reflectance().paint.quantify().paint.smooth(window=5).reflectance,
        lambda ds: ds.paint.reflectance().paint.quantify().paint.at(550.0).reflectance,
    ):  # fmt: skip
        xr.testing.assert_identical(
            of(view).drop_vars(set(of(line).coords)), of(line).drop_vars(set(of(line).coords))
        )
    # what pint-xarray turns back has text that is read
    np.testing.assert_allclose(
        view.pint.dequantify().paint.reflectance().reflectance, line.paint.reflectance().reflectance
    )


def test_a_quantity_stays_lazy(no_compute: Any) -> None:
    line = worked_example()
    milliwatts = 1000.0 * line.irradiance.chunk().data
    lazy = line.assign(irradiance=line.irradiance.copy(data=FIRST.Quantity(milliwatts, "mW/m^2/nm")))
    with no_compute():
        made = lazy.paint.reflectance()
    assert made.reflectance.chunks is not None
    np.testing.assert_allclose(made.reflectance, line.paint.reflectance().reflectance, rtol=3e-7)


def test_quantities_inside_of_dask_blocks_are_refused() -> None:
    line = worked_example()
    blocks = line.irradiance.chunk().data.map_blocks(lambda block: FIRST.Quantity(block, "mW/m^2/nm"))
    wrapped = line.assign(irradiance=line.irradiance.copy(data=blocks))
    expect_refusals((UnitsError, "array-foreign", "'irradiance'", lambda: wrapped.paint.reflectance()))


def level_line() -> xr.Dataset:
    # One line of three columns, flown level and to the north
    pose = {
        "latitude": 34.0,
        "longitude": -81.0,
        "altitude": 150.0,
        "roll": 0.0,
        "pitch": 0.0,
        "heading": 0.0,
    }
    line = xr.Dataset({name: ("along_track", [value]) for name, value in pose.items()})
    return line.assign_coords(cross_track=[0, 1, 2])


def test_units_of_places() -> None:
    line = level_line()
    line["latitude"].attrs["units"] = "degrees_north"
    line["longitude"].attrs["units"] = "degrees_east"
    line["altitude"] = ("along_track", FIRST.Quantity([150.0 / 0.3048], "ft"))
    convention = hp.Convention(column_order="left_to_right")
    camera = hp.geometry.PinholeCamera(3, field_of_view=90.0, edges="centres")
    assert hp.geometry.PinholeCamera(
        3, field_of_view=SECOND.Quantity(np.pi / 2, "rad"), edges="centres"
    ).field_of_view == pytest.approx(90.0)
    options = {"camera": camera, "convention": convention}
    SECOND.define("look = 2 * degree")  # a unit that only its own registry knows
    located = line.paint.locate(
        ground=50.0, lever_arm=(1.0, 2.0, 0.3048), boresight=(2.0, 0.0, 0.0), **options
    )
    other = line.paint.locate(
        ground=SECOND.Quantity(50 / 0.3048, "ft"),
        lever_arm=[100.0 * FIRST.cm, SECOND.Quantity(2.0, "m"), FIRST.Quantity(1.0, "ft")],
        boresight=SECOND.Quantity(np.array([1.0, 0.0, 0.0]), "look"),  # two degrees
        **options,
    )
    np.testing.assert_allclose(other.east, located.east, rtol=0, atol=1e-6)
    np.testing.assert_allclose(other.north, located.north, rtol=0, atol=1e-6)
    assert other.attrs["ground"] == pytest.approx(50.0)
    for wrong in (50.0 * FIRST.s, FIRST.Quantity(50.0, "degC"), "50 ft"):
        expect_error(UnitsError, "ground", partial(line.paint.locate, ground=wrong, **options))


def test_a_height_model_in_feet() -> None:
    line = level_line()
    options = {
        "camera": hp.geometry.PinholeCamera(3, field_of_view=30.0, edges="centres"),
        "convention": hp.Convention(column_order="left_to_right"), "crs": "EPSG:32617",
    }  # fmt: skip
    level = line.paint.locate(ground=50.0, **options)
    x, y = float(level.east.mean()), float(level.north.mean())
    dem = xr.DataArray(
        np.full((40, 40), 50.0), dims=("y", "x"), attrs={"height_reference": "ellipsoid"},
        coords={"y": y + np.arange(20, -20, -1) * 10.0, "x": x + np.arange(-20, 20) * 10.0},
    ).rio.write_crs("EPSG:32617")  # fmt: skip
    for heights in (
        dem,
        (dem / 0.3048).assign_attrs(dem.attrs, units="ft"),
        dem.copy(data=FIRST.Quantity(dem.values, "m")),
    ):
        np.testing.assert_allclose(
            line.paint.locate(dem=heights, **options).east, level.east, rtol=0, atol=1e-3
        )
    expect_error(
        UnitsError,
        "dem",
        lambda: line.paint.locate(dem=dem.assign_attrs(units="fathom of my own"), **options),
    )


def test_times_angles_and_shares() -> None:
    u = SECOND
    tilt = hp.Tilt(u.Quantity(np.pi / 6, "rad"), 90 * u.degree)
    assert (tilt.angle, tilt.azimuth) == (pytest.approx(30.0, rel=1e-12), 90.0)
    panel = hp.Panel(
        slice(0, 2), slice(0, 2), u.Quantity(50, "percent"), uncertainty=u.Quantity(2, "percent")
    )
    assert (panel.reflectance, panel.uncertainty) == (0.5, 0.02)
    zenith, _ = hp.light.solar_position(
        np.datetime64("2021-07-20T17:10"), u.Quantity(np.radians(34.0), "rad"), -81.0 * FIRST.degree
    )
    assert zenith == pytest.approx(
        hp.light.solar_position(np.datetime64("2021-07-20T17:10"), 34.0, -81.0)[0], rel=1e-11
    )
    calibration = hp.calibration
    assert calibration.etendue_from_optics(2.5, 7.4 * u.um, 20 * FIRST.um) == pytest.approx(
        1.8598e-11, rel=1e-4
    )
    sky = {"sun_zenith": u.Quantity(np.pi / 6, "rad")}
    paint = xr.Dataset(
        {"reflectance": ("band", FIRST.Quantity(np.array([4.2, 3.3]), "percent"))},
        {"wavelength": ("band", SECOND.Quantity(np.array([0.41, 0.85]), "um"))},
    )
    bare = paint.paint.remove_mirrored_sky(**sky)
    expected = xr.Dataset(
        {"reflectance": ("band", np.array([0.042, 0.033]), {"units": "1"})},
        {"wavelength": ("band", np.array([410.0, 850.0]), {"units": "nm"})},
    ).paint.remove_mirrored_sky(sun_zenith=30.0)
    np.testing.assert_allclose(bare.reflectance, expected.reflectance, atol=1e-7)
    assert (bare.reflectance < [0.036, 0.032]).all()  # a sky was removed
    expect_error(UnitsError, "strength", lambda: paint.paint.remove_mirrored_sky(strength=0.04 * u.m, **sky))


@pytest.mark.parametrize(
    "value",
    [lambda: 5 * FIRST.ms, lambda: pint.Quantity(5e3, "us"), lambda: np.timedelta64(5, "ms"),
     lambda: datetime.timedelta(milliseconds=5), lambda: SECOND.Quantity(5e-3, "s"),
     lambda: array(5.0, "ms"), lambda: array(5.0, "msec"), lambda: 0.005],
)  # fmt: skip
def test_an_exposure(value: Callable[[], Any]) -> None:
    assert float(in_units(value(), "s", "exposure_time")) == pytest.approx(0.005, rel=1e-15)


def test_a_flight_line_opened_with_quantities() -> None:
    line = flight(lines=4, columns=3).line
    line["counts"] = line.counts.astype(np.uint16)
    cube = line[["counts"]].drop_vars([name for name in line["counts"].coords if name != "wavelength"])
    calibration = line[["radiance_gain"]].assign_attrs(srf_shape="gaussian")
    options: dict[str, Any] = {
        "calibration": calibration,
        "dark": line[["dark_counts"]].assign(dark_exposure_time=line.exposure_time),
        "start_time": "2021-07-20T17:10:00Z",
    }  # fmt: skip
    opened = [
        hp.open_flightline(cube, exposure_time=exposure, frame_period=period, **options)
        for exposure, period in ((0.005, 0.007), (5 * FIRST.ms, SECOND.Quantity(7, "ms")))
    ]
    xr.testing.assert_identical(*opened)
    expect_error(
        UnitsError,
        "exposure_time",
        lambda: hp.open_flightline(cube, exposure_time=5 * FIRST.m, frame_period=0.007, **options),
    )


@takes_quantities(height="m")
def sized(
    count: int = 0,
    share: float = 0.0,
    part: slice | None = None,
    table: xr.Dataset | None = None,
    height: float = 0.0,
) -> tuple[Any, ...]:
    return count, share, part, table, height


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [("count", np.int8(100), 100), ("count", np.array(100, "u1"), 100), ("count", 4.0, 4),
     ("count", 4.5, None), ("count", "4", None), ("count", [4], None),
     ("share", np.float32(0.5), 0.5), ("share", "0.5", None),
     ("part", slice(3), slice(3)), ("part", 3, None), ("part", (0, 3), None),
     ("table", "lib.zarr", None), ("table", xr.DataArray([1.0]), None),
     ("height", array(1000.0, "mm"), 1.0), ("height", array(1.0, "m"), 1.0)],
)  # fmt: skip
def test_an_argument_is_of_the_kind_of_its_annotation(name: str, value: Any, expected: Any) -> None:
    if expected is None:
        expect_refusals((hp.SchemaError, "type-wrong", f"{name}=", lambda: sized(**{name: value})))
        return
    found = sized(**{name: value})[("count", "share", "part", "table", "height").index(name)]
    assert (found, type(found)) == (expected, type(expected))


def test_the_door_changes_no_call() -> None:
    expect_error(TypeError, "positional", lambda: hp.calibration.etendue_from_optics(2.5, 7.4e-6, 2e-5, 1.0))
    expect_error(TypeError, "missing", lambda: hp.calibration.etendue_from_optics(2.5))
    expect_error(TypeError, "unexpected", lambda: hp.calibration.etendue_from_optics(2.5, 7.4e-6, slit=2e-5))
    with pytest.raises(hp.SchemaError, match="exposure_time_ms='5'"):  # with all else that is wrong
        hp.simulation.SimulationSettings(exposure_time_ms="5")  # type: ignore[arg-type]


def test_a_simulation_set_up_with_quantities() -> None:
    settings = hp.simulation.SimulationSettings
    assert settings(
        exposure_time_ms=SECOND.Quantity(0.004, "s"), sun_zenith=FIRST.Quantity(np.pi / 6, "rad")
    ) == (
        settings(
            exposure_time_ms=4.0, sun_zenith=in_units(FIRST.Quantity(np.pi / 6, "rad"), "degree", "angle")
        )
    )
    assert hp.simulation.SweepSettings(step_exposure_ms=SECOND.Quantity(0.05, "s")).step_exposure_ms == 50.0
    expect_error(UnitsError, "fwhm_nm", lambda: settings(fwhm_nm=6 * FIRST.ms))


def test_units_in_a_library_of_strangers() -> None:
    pytest.importorskip("pint_xarray")
    library = hp.paints.starter_library(wavelength=np.arange(400.0, 1001.0, 20.0))
    assert np.isclose(
        hp.paints.starter_library(wavelength=FIRST.Quantity(np.arange(0.4, 1.001, 0.02), "um")).wavelength,
        library.wavelength,
    ).all()
    percent = library.assign(
        reflectance=library.reflectance.copy(
            data=SECOND.Quantity(library.reflectance.values * 100, "percent")
        )
    )
    np.testing.assert_allclose(hp.paints.paint_colours(percent), hp.paints.paint_colours(library), atol=1e-6)


def test_what_is_written_of_quantities_has_their_units(tmp_path: Path) -> None:
    pytest.importorskip("pint_xarray")
    line = flight(lines=8, columns=4).line.paint.reflectance().compute()
    view = line.paint.quantify()
    view["exposure_time"] = xr.DataArray(SECOND.Quantity(np.array(5.0), "ms"))
    hp.to_store(view, tmp_path / "lot.zarr")
    stored = hp.open_store(tmp_path / "lot.zarr")
    assert stored.exposure_time.attrs["units"] == "ms"
    np.testing.assert_allclose(stored.paint.reflectance().reflectance, line.reflectance, rtol=1e-6)
    hp.io.write_envi(view, tmp_path / "cube.hdr", variable="reflectance")
    np.testing.assert_array_equal(xr.open_dataset(tmp_path / "cube.hdr").reflectance, line.reflectance)
    library = hp.paints.starter_library(wavelength=np.arange(400.0, 1001.0, 20.0))
    percent = SECOND.Quantity(library.reflectance.values * 100, "percent")
    for name in ("library.csv", "library.sli", "library.zarr"):
        hp.write_library(library.assign(reflectance=library.reflectance.copy(data=percent)), tmp_path / name)
        back = hp.open_library(tmp_path / name)
        np.testing.assert_allclose(back.reflectance * (1.0 if back.reflectance.units == "1" else 0.01),
                                   library.reflectance, atol=1e-6)  # fmt: skip


def test_quantify_with_a_registry_of_ones_own() -> None:
    pytest.importorskip("pint_xarray")
    line = flight(lines=4, columns=3).line
    own = pint.UnitRegistry(force_ndarray_like=True)
    if "electrons_per_count" in line:
        expect_error(
            UnitsError, r"'electrons_per_count'.*electron.*define", lambda: line.paint.quantify(registry=own)
        )
        own.define("electron = [electron_count]")
    view = line.paint.quantify(registry=own)
    assert view.irradiance.data.units == own.Unit("W/m**2/nm")
    assert (view.irradiance * 2).data.to("mW/m**2/nm").magnitude.max() == pytest.approx(
        2e3 * float(line.irradiance.max()), rel=1e-6
    )
    expect_error(UnitsError, "registry-scalars", lambda: line.paint.quantify(registry=pint.UnitRegistry()))
    xr.testing.assert_identical(quantify(view, own).irradiance, view.irradiance)


def test_plain_gives_back_what_holds_no_quantity() -> None:
    line = flight(lines=4, columns=3).line
    assert plain(line) is line
    assert plain(line.counts) is not None
    tree = xr.DataTree.from_dict(
        {"/a": xr.Dataset({"t": ("x", FIRST.Quantity([1.0, 2.0], "ms"))}), "/b": xr.Dataset()}
    )
    assert plain(tree)["a/t"].attrs == {"units": "ms"}
    assert plain(plain(tree)) is not None
    assert plain(
        xr.DataArray(
            [1.0, 2.0], dims="x", coords={"w": ("x", FIRST.Quantity(np.array([3.0, 4.0]), "um"))}, name="w"
        )
    ).w.attrs == {"units": "um"}


def test_other_packages_units_are_read_by_their_text() -> None:
    class Quantity:  # what astropy's has
        value, unit = 0.55, "um"

        def to_value(self, unit: str) -> float:
            raise NotImplementedError

    assert in_units(Quantity(), "nm", "wavelength") == pytest.approx(550.0)


ROOMS = ("light", "radiometry", "calibration", "alignment", "surroundings", "geometry", "regions", "paints",
         "validation", "pictures", "io")  # fmt: skip
PUBLIC = {
    f"{room}.{name}": getattr(getattr(hp, room), name) for room in ROOMS for name in dir(getattr(hp, room))
}
UNIT = re.compile(r"\[(degree|rad|m|nm|um|s|ms|count|K|W[^\]]*)\]")


@pytest.mark.parametrize("name", [name for name, public in PUBLIC.items() if inspect.isfunction(public)])
def test_every_public_argument_with_a_unit_passes_the_door(name: str) -> None:
    function = PUBLIC[name]
    parameters = (inspect.getdoc(function) or "").partition("Parameters\n")[2].partition("\nReturns\n")[0]
    takes_numbers = any(
        "float" in str(parameter.annotation) or "ArrayLike" in str(parameter.annotation)
        for parameter in inspect.signature(function).parameters.values()
    )
    assert hasattr(function, "__wrapped__") or not (takes_numbers and UNIT.search(parameters))
