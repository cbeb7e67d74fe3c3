"""Libraries of hyperpaint 0.2 and before, whose dimension was `paint`, open and are used under today's name.

``released/version_1.zip`` holds the three paints of the conformance files as 0.2 wrote them, and as netCDF;
``released/version_2.zip`` with the metadata that followed, under today's names.
"""

import itertools
import json
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from support.library_examples import declared_library
from support.refusals import expect_errors

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning
from hyperpaint.base.old_names import with_new_names

FILES = ("paints.csv", "paints.sli", "paints.parquet", "paints.zarr")


@pytest.fixture
def released(tmp_path: Path) -> Path:
    with zipfile.ZipFile(Path(__file__).with_name("released") / "version_1.zip") as archive:
        archive.extractall(tmp_path)
    return tmp_path


@pytest.fixture
def library() -> xr.Dataset:
    return declared_library(bands=6)


def old(library: xr.Dataset) -> xr.Dataset:
    # Return a library as a session of hyperpaint 0.2 held it.
    return library.rename(signature="paint").assign_attrs(paint_library_version=1)


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_0_2_is_todays_library(released: Path, library: xr.Dataset, name: str) -> None:
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    with pytest.warns(PaintWarning, match="'paint'.*'signature'") as caught:
        opened = hp.open_library(released / name)
    assert len(caught) == 1
    xr.testing.assert_equal(opened.load(), library)
    assert opened.attrs["paint_library_version"] == 2
    assert "signature" in opened.indexes
    with pytest.warns(PaintWarning, match="'signature'"):
        assert hp.io.check_library(released / name).ok
    xr.testing.assert_equal(
        hp.open_library(hp.write_library(opened, released / "again" / name, curves="all")).load(), library
    )


@pytest.mark.parametrize("name", FILES[:3])
def test_metadata_of_version_2_are_read(tmp_path: Path, library: xr.Dataset, name: str) -> None:
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    with zipfile.ZipFile(Path(__file__).with_name("released") / "version_2.zip") as archive:
        archive.extractall(tmp_path)
    xr.testing.assert_identical(hp.open_library(tmp_path / name), library)


def test_a_table_of_0_2_without_its_metadata_opens(released: Path) -> None:
    (released / "paints.csv.json").unlink()
    with pytest.warns(PaintWarning, match="is missing"):
        opened = hp.open_library(released / "paints.csv")
    assert opened["signature"].values.tolist() == ["red", "blue", "black"]


def test_a_netcdf_of_0_2_is_taken_by_functions(released: Path, library: xr.Dataset) -> None:
    pytest.importorskip("netCDF4")
    with xr.open_dataset(released / "paints.nc") as opened, pytest.warns(PaintWarning, match="'signature'"):
        path = hp.write_library(opened, released / "new.zarr")
    xr.testing.assert_equal(hp.open_library(path).load(), library)


def test_a_library_of_an_old_session_is_taken_everywhere(library: xr.Dataset, tmp_path: Path) -> None:
    jobs = {
        "validate": lambda lib: hp.validate(lib, lib).statistics["signature"].values.tolist(),
        "dirsig": lambda lib: hp.write_dirsig(lib, tmp_path / str("paint" in lib.dims))[
            "signature"
        ].values.tolist(),
        "search": lambda lib: hp.paints.search_library(lib, name="red")["signature"].values.tolist(),
        "colours": lambda lib: hp.paints.paint_colours(lib).tolist(),
        "sample": lambda lib: hp.paints.sample_paints(lib, 3)["signature"].values.tolist(),
        "mix": lambda lib: hp.paints.shade_paints(lib, [0.5])["signature"].values.tolist(),
        "check": lambda lib: hp.io.check_library(lib).ok,
        "declare": lambda lib: dict(hp.io.declare_library(lib).sizes),
        "summary": lambda lib: "3 paints" in repr(lib.paint),
        "figure": lambda lib: len(lib.paint.spectrum().lines),
    }
    for name, job in jobs.items():
        with pytest.warns(PaintWarning, match="'signature'"):
            found = job(old(library))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PaintWarning)
            assert found == job(library), name


def test_only_libraries_are_renamed(library: xr.Dataset) -> None:
    for dataset in (
        xr.Dataset({"reflectance": (("paint", "band", "cross_track"), np.zeros((1, 2, 3)))}),
        xr.Dataset({"reflectance": ("x", [1.0])}, {"paint": ("x", ["red"])}),
        library,
        xr.Dataset({"paint": ("paint", [1])}),
    ):
        assert with_new_names(dataset) is dataset
    with pytest.warns(PaintWarning):
        one = with_new_names(old(library).isel(paint=0))
    assert one["signature"].item() == "red"
    with pytest.warns(PaintWarning):
        spectra = with_new_names(old(library)["reflectance"])
    assert spectra.dims == ("signature", "band")


def test_a_property_called_signature_keeps_its_values(library: xr.Dataset) -> None:
    mine = old(library).assign_coords(signature=("paint", ["a", "b", "c"]))
    with pytest.warns(PaintWarning):
        renamed = with_new_names(mine)
    assert (renamed["signature"].values.tolist(), renamed["paint"].values.tolist()) == (
        ["red", "blue", "black"],
        ["a", "b", "c"],
    )
    assert "signature" in renamed.indexes


@pytest.mark.parametrize(
    ("part", "damage"),
    [
        *itertools.product(("spectra", "variables", "attrs", "sizes"), (None, 3, [1])),
        *itertools.product(("spectra", "variables"), ({"paint": 3}, {"paint": {"dims": [1, "paint"]}})),
    ],
)
def test_damaged_metadata_of_0_2_are_refused(released: Path, part: str, damage: object) -> None:
    file = released / "paints.csv.json"
    file.write_text(
        json.dumps({**json.loads(file.read_text(encoding="utf-8")), part: damage}), encoding="utf-8"
    )
    with pytest.warns(PaintWarning, match="'signature'"), pytest.raises(FormatError):
        hp.open_library(released / "paints.csv")


@pytest.mark.parametrize("curves", ["centre", "all"])
def test_our_table_comes_back_through_pandas_with_its_index(
    library: xr.Dataset, tmp_path: Path, curves: str
) -> None:
    path = hp.write_library(library, tmp_path / "own.csv", curves=curves)
    pd.read_csv(path).to_csv(tmp_path / "index.csv")
    with pytest.warns(PaintWarning, match="is missing"):
        opened = hp.open_library(tmp_path / "index.csv")
    assert opened["signature"].values.tolist() == ["red", "blue", "black"]
    np.testing.assert_array_equal(opened["reflectance"], library["reflectance"])
    pd.read_csv(path).iloc[::-1].to_csv(tmp_path / "turned.csv")
    expect_errors((FormatError, "column-name-missing", lambda: hp.open_library(tmp_path / "turned.csv")))
