"""What a dataset says of itself in a notebook: nothing computed, nothing believed."""

import base64
import re
import shutil
import struct
import zlib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.refusals import expect_words
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.schema import Quality
from hyperpaint.pictures.figures import encode_png, label_for
from hyperpaint.report.summaries import stored_overview


def with_overview(line: xr.Dataset) -> xr.Dataset:
    picture = np.arange(24 * 6 * 3, dtype=np.uint8).reshape(24, 6, 3)
    attrs = {"line_step": 1, "column_step": 1}
    return line.assign(overview=(("overview_y", "overview_x", "rgb"), picture, attrs))


def test_a_flight_line_and_a_library_in_words() -> None:
    shown = repr(flight().line.paint)
    assert shown.startswith("flight line raw_0\n")
    expect_words(
        shown,
        "24 along_track x 12 band x 6 cross_track, float32 [count]",
        "500 to 700 nm, fwhm 6 nm",
        "2020-06-21T17:00:10.000 to 2020-06-21T17:00:10.161 UTC",
        ".reflectance()",
    )
    region = hp.Region("hood", [(0, 0), (2, 0), (2, 9), (0, 9)])
    library = repr(hp.extract_signatures(flight().line, hp.Regions((region,)), exclude=0).paint)
    assert library.startswith("paint library")
    expect_words(library, "1 paint: hood", "30 to 30 a paint")


def test_flags_are_told_where_they_are_at_hand() -> None:
    line = flight().line
    quality = np.zeros((24, 6), np.uint16)
    quality[:6] = Quality.GLINT
    known = line.assign(quality=(("along_track", "cross_track"), quality))
    assert "glint 25 %" in repr(known.paint)
    assert "not computed yet" in repr(known.chunk(along_track=8).paint)
    assert "no flag set" in repr(known.assign(quality=known.quality * np.uint16(0)).paint)


def test_nothing_is_computed(no_compute: Any) -> None:
    # small variables as they are, cubes lazy
    whole = with_overview(flight().line)
    line = whole.chunk(along_track=8).assign_coords(whole.coords)
    line = line.assign(
        {name: whole[name] for name in whole.data_vars if "along_track" not in whole[name].dims}
    ).paint.reflectance()
    line["overview"] = line.overview.chunk(overview_y=8)
    with no_compute():
        shown = line.paint._repr_html_()
    assert "not computed yet" in shown
    # a picture that would have to be computed is not
    assert "<img" not in shown


def test_the_stored_picture_is_shown(tmp_path: Path) -> None:
    hp.to_store(with_overview(flight().line), tmp_path / "lot.zarr", "flightlines/raw_0")
    line = xr.open_zarr(tmp_path / "lot.zarr", group="flightlines/raw_0")
    found = re.search(r'src="data:image/png;base64,([^"]+)"', line.paint.reflectance().paint._repr_html_())
    assert found
    # along_track to the right
    assert struct.unpack(">II", base64.b64decode(found[1])[16:24]) == (24, 6)
    np.testing.assert_array_equal(stored_overview(line), with_overview(flight().line).overview)


def test_a_store_that_is_gone_is_no_error(tmp_path: Path) -> None:
    hp.to_store(with_overview(flight().line), tmp_path / "lot.zarr")
    line = xr.open_zarr(tmp_path / "lot.zarr")
    shutil.rmtree(tmp_path / "lot.zarr")
    assert "flight line" in repr(line.paint)
    assert "flight line" in line.paint._repr_html_()


@pytest.mark.parametrize(
    "odd",
    [
        xr.Dataset(),
        xr.Dataset({"a": 1}),
        xr.Dataset({"reflectance": ("signature", [1.0])}),
        xr.Dataset({"counts": ("along_track", ["x"])}, {"wavelength": ("band", ["red"]), "time": 3}),
        xr.Dataset({"overview": (("overview_y", "overview_x", "rgb"), np.zeros((0, 3, 3), "u1"))}),
    ],
)
def test_any_dataset_has_a_summary(odd: xr.Dataset) -> None:
    assert repr(odd.paint)
    HTMLParser().feed(odd.paint._repr_html_())


def test_names_and_attributes_stay_texts() -> None:
    line = flight().line.assign_attrs(name="<script>\x1b[31m", dark_source="<img src=x>")
    expect_words(
        line.paint._repr_html_(),
        "&lt;script&gt;",
        without=("<script", "<img"),
    )
    assert "\x1b" not in repr(line.paint)


def test_png_holds_the_picture() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    made = encode_png(picture)
    kinds, at = {}, 8
    while at < len(made):
        (size,) = struct.unpack(">I", made[at : at + 4])
        kind, data = made[at + 4 : at + 8], made[at + 8 : at + 8 + size]
        assert struct.unpack(">I", made[at + 8 + size : at + 12 + size])[0] == zlib.crc32(kind + data)
        kinds[kind] = data
        at += 12 + size
    rows = np.frombuffer(zlib.decompress(kinds[b"IDAT"]), np.uint8).reshape(5, 22)
    assert not rows[:, 0].any()
    np.testing.assert_array_equal(rows[:, 1:].reshape(5, 7, 3), picture)


def test_labels_are_letters() -> None:
    assert (
        label_for("$\\frac{1}$"),
        label_for("_hidden"),
        label_for("a\nb\x00"),
        len(label_for("x" * 500)),
    ) == (r"\$\frac{1}\$", " _hidden", "a\ufffdb\ufffd", 60)


def test_a_library_shows_the_colours_of_its_paints() -> None:
    nm = np.arange(400.0, 701.0, 10.0)
    spectra = [np.where(nm > 600, 0.8, 0.03), np.full(nm.size, 0.9), np.full(nm.size, np.nan)]
    library = xr.Dataset(
        {
            "reflectance": (("signature", "band"), np.float32(spectra), {"units": "1"}),
            "n": ("signature", [120, 7, 0], {"units": "1"}),
        },
        {"signature": ["red", "<b>white</b>", "none"], "wavelength": ("band", nm, {"units": "nm"})},
    )
    shown = library.paint._repr_html_()
    colours = re.findall(r"background:(#[0-9a-f]{6})", shown)
    red, white = (np.frombuffer(bytes.fromhex(colour[1:]), np.uint8).astype(int) for colour in colours)
    assert red[0] > 200
    assert red[1:].max() < 100
    # level spectra are grey: 0.9 is 243 in sRGB
    assert np.abs(white - 243).max() <= 2
    assert shown.count('role="img"') == 3
    expect_words(shown, "n = 120", "&lt;b&gt;white", without=("<b>",))
    # at home on a page of either theme
    assert "currentColor" in shown
    assert "color:" not in shown.replace("border-color:", "")
    with_quantities = library.assign(reflectance=library.reflectance * 100)
    with_quantities["reflectance"].attrs["units"] = "percent"
    assert re.findall(r"background:(#[0-9a-f]{6})", with_quantities.paint._repr_html_()) == colours


def test_colours_are_not_computed(no_compute: Any) -> None:
    nm = np.arange(400.0, 701.0, 10.0)
    library = xr.Dataset(
        {"reflectance": (("signature", "band"), np.full((2, nm.size), 0.5, "f4"), {"units": "1"})},
        {"signature": ["a", "b"], "wavelength": ("band", nm, {"units": "nm"})},
    )
    lazy = library.assign(reflectance=library.reflectance.chunk(signature=1))
    with no_compute():
        assert 'role="img"' not in lazy.paint._repr_html_()
