"""Parquet in the columns of OpenSpecLib: read by pyarrow alone, and files of others."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xarray as xr
from support.refusals import expect_errors

import hyperpaint as hp


def foreign(path, **changes):
    # Write a file as OpenSpecLib describes it, with pyarrow alone.
    wavelengths = [0.4, 0.5, 0.6]
    columns = {
        "id": ["usgs:1", "usgs:2"], "name": ["olivine", "asphalt"],
        "source.license": ["public domain"] * 2, "source.citation": ["Kokaly 2017"] * 2,
        "spectral_data.type": ["reflectance"] * 2, "spectral_data.wavelength_unit": ["um"] * 2,
        "spectral_data.wavelengths": [wavelengths] * 2,
        "spectral_data.values": [[0.1, None, 0.3], [0.2, 0.2, 0.2]], "additional_properties": ["{}"] * 2,
    } | changes  # fmt: skip
    pq.write_table(pa.table(columns), path)
    return path


def test_a_file_of_others_is_a_library(tmp_path):
    library = hp.open_library(foreign(tmp_path / "usgs.parquet"))
    np.testing.assert_allclose(library.wavelength, [400.0, 500.0, 600.0])
    assert library["signature"].values.tolist() == ["olivine", "asphalt"]
    np.testing.assert_array_equal(library.reflectance, np.float32([[0.1, np.nan, 0.3], [0.2, 0.2, 0.2]]))
    assert library.licence.values.tolist() == ["public domain"] * 2
    library = hp.open_library(
        foreign(
            tmp_path / "tes.parquet",
            **{
                "spectral_data.wavelength_unit": ["cm-1"] * 2,
                "spectral_data.wavelengths": [[20000.0, 16000.0, 12500.0]] * 2,
            },
        )
    )
    np.testing.assert_allclose(library.wavelength, [500.0, 625.0, 800.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"spectral_data.type": ["emissivity"] * 2}, "quantity-wrong"),
        ({"spectral_data.wavelength_unit": ["um", "nm"]}, "units-unknown"),
        ({"spectral_data.wavelengths": [[0.4, 0.5, 0.6], [0.4, 0.5, 0.7]]}, "different wavelengths"),
        ({"spectral_data.values": [[0.1, 0.2], [0.2, 0.2, 0.2]]}, "row 0.*length-mismatch"),
        ({"spectral_data.values": [None, [0.2, 0.2, 0.2]]}, "row 0.*length-mismatch"),
    ],
)
def test_what_is_no_library_is_refused(tmp_path, changes, message):
    expect_errors(
        (hp.FormatError, message, lambda: hp.open_library(foreign(tmp_path / "x.parquet", **changes)))
    )


def test_damaged_files_are_refused(tmp_path):
    whole = foreign(tmp_path / "x.parquet").read_bytes()
    pq.write_table(pa.table({"name": ["a"]}), tmp_path / "x.parquet")
    expect_errors((hp.FormatError, "column-missing", lambda: hp.open_library(tmp_path / "x.parquet")))
    for cut in (4, 40, len(whole) // 2, len(whole) - 4):
        (tmp_path / "cut.parquet").write_bytes(whole[:cut])
        with pytest.raises(hp.FormatError, match="file-unreadable"):
            hp.open_library(tmp_path / "cut.parquet")


def test_pandas_readers_see_a_row_a_paint(tmp_path):
    starter = hp.paints.starter_library(members=2)
    path = hp.write_library(starter, tmp_path / "starter.parquet")
    rows = pq.read_table(path).to_pylist()
    assert (
        [row["material.name"] for row in rows],
        {row["material.category"] for row in rows},
        json.loads(rows[0]["additional_properties"])["finish"],
    ) == (starter["signature"].values.tolist(), {"man_made"}, "solid")
    np.testing.assert_array_equal(
        np.float32([row["spectral_data.values"] for row in rows]), starter.reflectance.values
    )
    path.with_name("starter.parquet.json").unlink()  # as others hand it on
    alone = hp.open_library(path)
    np.testing.assert_array_equal(alone.reflectance.values, starter.reflectance.values)
    assert alone["signature"].values.tolist() == starter["signature"].values.tolist()


def test_paints_of_one_name_stay_apart(tmp_path):
    starter = (
        hp.paints.starter_library(members=3)
        .isel(signature=[0, 1, 2])
        .assign_coords(signature=["a", "a", "b"])
    )
    path = hp.write_library(starter, tmp_path / "p.parquet", curves="all")
    xr.testing.assert_identical(hp.open_library(path), starter)
    # a number beyond 64 bits
    rows = pq.read_table(path)
    keys = [
        text.replace('"place": 2', f'"place": {10**30}') for text in rows["additional_properties"].to_pylist()
    ]
    at = rows.schema.get_field_index("additional_properties")
    pq.write_table(rows.set_column(at, rows.schema.field(at), pa.array(keys)), path)
    expect_errors((hp.FormatError, "record-unmatched", lambda: hp.open_library(path)))
