"""Irradiance records with faults of the instrument, each named and left out; and right ones, left alone."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError
from hyperpaint.light.clear_sky import ClearSky

NM = np.arange(350.0, 1076.0)
SCANS = 40
Change = Callable[[np.ndarray], np.ndarray]


def sky(zenith: float = 45.0, noise: float = 0.003, seed: int = 0, scans: int = SCANS) -> np.ndarray:
    # Irradiance of a clear sky (scan, channel) with noise and the sun's course [W m-2 nm-1]
    rng = np.random.default_rng(seed)
    course = 1.0 + 2e-4 * np.arange(scans)[:, None]
    clear = sum(ClearSky(zenith).irradiance(NM))
    return clear * course * (1.0 + rng.normal(0.0, noise, (scans, NM.size)))


def opened(values: np.ndarray, interval_s: float = 1.0) -> xr.Dataset:
    stamps = np.datetime64("2024-05-21T16:00", "ns") + (np.arange(len(values)) * interval_s * 1e9).astype(
        "timedelta64[ns]"
    )
    record = xr.DataArray(
        values,
        {"time": stamps, "wavelength": ("wavelength", NM, {"units": "nm"})},
        ("time", "wavelength"),
        attrs={"units": "W m-2 nm-1"},
    )
    return hp.open_irradiance(record, fwhm_nm=3.0)


def scan(number: int, change: Change) -> Change:
    return lambda values: np.where(np.arange(len(values))[:, None] == number, change(values), values)


def channels(first: float, last: float, change: Change) -> Change:
    return lambda values: np.where((first <= NM) & (last >= NM), change(values), values)


#: Fault, change of a right record, code, whether it is refused, and shares of scans and channels that stay.
WRONG = (
    ("shaded", scan(17, lambda e: 0.1 * e), "irradiance-scans", 39, 1.0),
    ("shaded, first scan", scan(0, lambda e: 0.1 * e), "irradiance-scans", 39, 1.0),
    (
        "shaded twice",
        lambda e: scan(17, lambda x: 0.1 * x)(scan(19, lambda x: 0.5 * x)(e)),
        "irradiance-scans",
        38,
        1.0,
    ),
    ("a lamp beside the receptor", scan(8, lambda e: e + 0.6), "irradiance-scans", 39, 1.0),
    ("scan from red to blue", scan(25, lambda e: e[:, ::-1]), "irradiance-scans", 39, 1.0),
    ("fill of 16 bits", scan(20, lambda e: 0 * e + 65535.0), "irradiance-scans", 39, 1.0),
    ("negative", scan(30, lambda e: -e), "irradiance-scans", 39, 1.0),
    (
        "one channel of one scan",
        scan(12, channels(600, 600, lambda e: 0 * e - 1.0)),
        "irradiance-scans",
        39,
        1.0,
    ),
    ("channels of 9999", channels(520, 540, lambda e: 0 * e + 9999.0), "irradiance-channels", 40, 0.971),
    ("channels of zero", channels(700, 712, lambda e: 0 * e), "irradiance-channels", 40, 0.982),
    ("clipped", lambda e: np.minimum(e, 0.85 * e.max()), "irradiance-channels", 40, 0.8),
    ("stuck", channels(640, 650, lambda e: 0 * e + e[:1]), "irradiance-channels", 40, 0.985),
    ("gain", lambda e: e * np.where(np.arange(len(e)) < 22, 1.0, 0.8)[:, None], "irradiance-step", 40, 1.0),
)
#: Refused changes.
REFUSED = (
    ("every second channel zero", lambda e: e * (np.arange(NM.size) % 2)),
    ("every second channel at half", lambda e: e * (1.0 - 0.5 * (np.arange(NM.size) % 2))),
    ("clipped at a third", lambda e: np.minimum(e, e.max() / 3.0)),
    ("most scans are fill", lambda e: np.where(np.arange(len(e))[:, None] % 3 > 0, -999.0, e)),
)


@pytest.mark.parametrize(
    ("change", "code", "scans", "share"), [row[1:] for row in WRONG], ids=[row[0] for row in WRONG]
)
def test_faults_are_named_and_left_out(change: Change, code: str, scans: int, share: float) -> None:
    right = sky()
    with pytest.warns(PaintWarning) as caught:
        record = opened(change(right))
    assert {warning.message.code for warning in caught} == {code}  # type: ignore[union-attr]
    assert code in record.attrs["irradiance_faults"]
    values = record["irradiance"].values
    is_kept = np.isfinite(values)
    assert is_kept.all(axis=1).sum() == scans or share < 1.0
    assert is_kept.any(axis=0).mean() == pytest.approx(share, abs=0.06 if share == 0.8 else 0.002)
    if code != "irradiance-step":  # values that remain are right
        np.testing.assert_allclose(values[is_kept], right[is_kept], rtol=2e-3)


@pytest.mark.parametrize("change", [row[1] for row in REFUSED], ids=[row[0] for row in REFUSED])
def test_too_little_light_is_refused(change: Change) -> None:
    expect_errors((SchemaError, "irradiance-lost", lambda: opened(change(sky()))))


def ramp(first: int, last: int, depth: float) -> Change:
    # a cloud that dims the sun, red more than blue
    blocked = np.clip((np.arange(SCANS) - first) / (last - first), 0.0, 1.0)[:, None]
    return lambda e: e * (1.0 - depth * blocked * np.clip(NM / 800.0, 0.5, 1.0))


RIGHT: tuple[tuple[str, Callable[[], np.ndarray], float], ...] = (
    ("clear", lambda: sky(), 1.0),
    ("noise of 2 %", lambda: sky(noise=0.02), 1.0),
    ("low sun", lambda: sky(85.0, 0.01), 1.0),
    ("edge of a cloud", lambda: ramp(14, 24, 0.7)(sky()), 1.0),
    ("edge of a cloud between two scans", lambda: ramp(14, 15, 0.7)(sky()), 1.0),
    ("small cloud", lambda: ramp(10, 14, 0.6)(sky()) / ramp(16, 20, 0.6)(np.ones((SCANS, NM.size))), 1.0),
    ("single cloud in slow scans", lambda: scan(20, ramp(0, 1, 0.7))(sky()), 30.0),
    ("three digits", lambda: np.array([[float(f"{x:.3g}") for x in row] for row in sky(noise=1e-4)]), 1.0),
    ("two digits", lambda: sky(noise=1e-4).round(2), 1.0),
    ("four scans", lambda: sky(scans=4), 20.0),
)


@pytest.mark.parametrize(("values", "interval_s"), [row[1:] for row in RIGHT], ids=[row[0] for row in RIGHT])
@pytest.mark.filterwarnings("error")
def test_right_records_stay(values: Callable[[], np.ndarray], interval_s: float) -> None:
    right = values()
    record = opened(right, interval_s)
    np.testing.assert_array_equal(record["irradiance"], right.astype("f4"))
    assert "irradiance_faults" not in record.attrs
