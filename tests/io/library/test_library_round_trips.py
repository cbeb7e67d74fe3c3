"""What is written comes back: bit for bit, and byte for byte when it is written again."""

import csv
import json
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xarray as xr
from hypothesis import given, settings, strategies as st
from support import painted_lines
from support.library_examples import NAMES, make_library
from support.refusals import expect_errors, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, PaintWarning, SchemaError

SPY_ON_NUMPY_2_5 = pytest.mark.filterwarnings("ignore:Setting the shape on a NumPy array:DeprecationWarning")


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def trip(library: xr.Dataset, folder: Path, name: str, **options: Any) -> xr.Dataset:
    # Write, read and write again; the two are the same byte for byte.
    first = hp.write_library(library, folder / "one" / name, **options)
    found = hp.open_library(first)
    second = hp.write_library(found, folder / "two" / name, **options)
    assert files_of(first.parent) == files_of(second.parent)
    return found


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_sli_and_csv__give_the_library_back(library: xr.Dataset, tmp_path: Path, name: str) -> None:
    # Expected: every value, dtype, attribute and name, members with their padding, and NaN as it was.
    for folder, one in (("rising", library), ("falling", library.isel(band=slice(None, None, -1)))):
        found = trip(one, tmp_path / folder, name, curves="all")
        xr.testing.assert_identical(found, one)
    assert {key: found[key].dtype for key in library.variables} == dict(library.dtypes) | {
        key: library[key].dtype for key in library.coords
    }


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_files_do_not_depend_on_the_order_of_coordinates(
    library: xr.Dataset, tmp_path: Path, name: str
) -> None:
    # xarray gathers coordinates from sets, whose order follows PYTHONHASHSEED.
    coords = {key: library.variables[key] for key in reversed([*library.coords])}
    turned = xr.Dataset(library.reset_coords(drop=True).data_vars, coords, library.attrs)
    paths = [
        hp.write_library(one, tmp_path / folder / name, curves="all")
        for folder, one in (("one", library), ("two", turned))
    ]
    one, two = (files_of(path.parent) for path in paths)
    assert one == two


def test_zarr__gives_the_library_back(library: xr.Dataset, tmp_path: Path) -> None:
    found = hp.open_library(hp.write_library(library, tmp_path / "paints.zarr"))
    assert found["member_reflectance"].chunks is not None
    for name, variable in library.variables.items():
        np.testing.assert_array_equal(found[name].values, variable.values, err_msg=str(name))
    assert hp.verify(tmp_path / "paints.zarr").ok


@SPY_ON_NUMPY_2_5
def test_sli__is_read_by_spy(library: xr.Dataset, tmp_path: Path) -> None:
    # Expected: SPy finds the centres first, under their names, and members named after their paint.
    envi = pytest.importorskip("spectral.io.envi")
    path = hp.write_library(library, tmp_path / "paints.sli", curves="all")
    theirs = envi.open(str(path.with_suffix(".hdr")), str(path))
    assert list(theirs.names[:5]) == ["red; matt", "Grün", "Grün (2)", 'a/b "x" / c (d)', "unnamed"]
    np.testing.assert_array_equal(theirs.spectra[:5], library["reflectance"].values)
    np.testing.assert_array_equal(
        theirs.spectra[list(theirs.names).index("Grün (2) | member 3")],
        library["member_reflectance"].values[2, 2],
    )
    np.testing.assert_array_equal(theirs.bands.centers, library["wavelength"].values)
    # the header of centres has the columns of the paints
    path = hp.write_library(library, tmp_path / "centres.sli")
    theirs = envi.open(str(path.with_suffix(".hdr")), str(path))
    assert theirs.spectra.shape == library["reflectance"].shape
    assert theirs.metadata["paint make"] == ["VW", "", "Škoda", "a b", "ß"]
    assert theirs.metadata["paint year"] == ["2001", "2", "3", "4", "5"]


def test_csv__of_all_curves_says_what_each_row_is(library: xr.Dataset, tmp_path: Path) -> None:
    with open(
        hp.write_library(library, tmp_path / "paints.csv", curves="all"), encoding="utf-8-sig", newline=""
    ) as file:
        head, *rows = csv.reader(file)
    assert head[:3] == ["signature", "variable", "place"]
    first = len(head) - library.sizes["band"]
    assert [float(cell) for cell in head[first:]] == library["wavelength"].values.tolist()
    assert ({len(row) for row in rows}, [row[0] for row in rows[:5]]) == ({len(head)}, NAMES)
    assert [np.float32(cell) for cell in rows[1][first:]] == library["reflectance"].values[1].tolist()
    members = [row for row in rows if row[1] == "member_reflectance"]
    assert [(row[0], row[2]) for row in members if row[0].startswith("Grün")] == [
        *[("Grün", str(place)) for place in (1, 2)],  # padding is left out
        *[("Grün (2)", str(place)) for place in (1, 2, 3, 4)],
    ]
    assert (
        json.loads((tmp_path / "paints.csv.json").read_text(encoding="utf-8"))["coords"]["make"]["data"]
        == library["make"].values.tolist()
    )


def test_csv__is_a_rectangle_for_pandas_and_excel(library: xr.Dataset, tmp_path: Path) -> None:
    # Expected: a row a paint, what is said of it, then numbers alone; Excel knows UTF-8 by its mark.
    path = hp.write_library(library, tmp_path / "paints.csv")
    assert path.read_bytes().startswith(b"\xef\xbb\xbfsignature,make,n,n_eff,quality,time,year,400.0,")
    table = pd.read_csv(path, keep_default_na=False, na_values={"n_eff": [""]}, dtype={"make": str})
    assert (table["signature"].tolist(), table["make"].tolist()) == (NAMES, ["VW", "", "Škoda", "a b", "ß"])
    assert table["year"].tolist() == [2001, 2, 3, 4, 5]
    np.testing.assert_array_equal(table["n_eff"], library["n_eff"])
    assert str(table["time"][0]) == "2024-05-21T11:33:07.123456789"
    values = table.iloc[:, table.columns.get_loc("400.0") :]
    assert [float(name) for name in values.columns] == library["wavelength"].values.tolist()
    np.testing.assert_array_equal(values.to_numpy("f4"), library["reflectance"].values)
    assert (
        hp.write_library(
            library.isel(signature=[0]).assign_coords(make=("signature", np.array(["VW"], object))),
            tmp_path / "plain.csv",
        )
        .read_bytes()
        .startswith(b"signature,")
    )


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_centres__are_the_default_and_come_back(library: xr.Dataset, tmp_path: Path, name: str) -> None:
    # Expected: the centre and what is said of paints, to the bit; no member, quantile or spread.
    xr.testing.assert_identical(
        trip(library, tmp_path, name), library.drop_vars(["reflectance_sd"]).drop_dims(["member", "quantile"])
    )
    if name == "paints.csv":
        assert len((tmp_path / "one" / name).read_text(encoding="utf-8-sig").splitlines()) == 1 + len(NAMES)
    else:
        assert (tmp_path / "one" / name).stat().st_size == 4 * library["reflectance"].size


def test_formats_hold_what_they_can(library: xr.Dataset, tmp_path: Path) -> None:
    expect_errors(
        (
            SchemaError,
            "choice-unknown",
            lambda: hp.write_library(library, tmp_path / "paints.csv", curves="members"),
        )
    )
    assert not {"member", "quantile"} & {
        *hp.open_library(hp.write_library(library, tmp_path / "paints.zarr", curves="centre")).dims
    }


def test_csv__written_by_earlier_versions_opens(library: xr.Dataset, tmp_path: Path) -> None:
    # Rationale: the earlier table had no columns between the place and the wavelengths, and no mark.
    path = hp.write_library(library, tmp_path / "paints.csv", curves="all")
    with open(path, encoding="utf-8-sig", newline="") as file:
        rows = list(csv.reader(file))
    first = len(rows[0]) - library.sizes["band"]
    with open(path, "w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(row[:3] + row[first:] for row in rows)
    xr.testing.assert_identical(hp.open_library(path), library)


def test_csv__edited_in_a_spreadsheet(library: xr.Dataset, tmp_path: Path) -> None:
    # Expected: a column that is new is taken; one that contradicts the metadata is not, which is said.
    path = hp.write_library(library, tmp_path / "paints.csv")
    table = pd.read_csv(path, keep_default_na=False)
    table.insert(1, "finish", ["matt", "matt", "gloss", "gloss", ""])
    table.insert(1, "layers", [1, 2, 3, 4, ""])
    table.to_csv(path, index=False)
    found = hp.open_library(path)
    assert found["finish"].values.tolist() == ["matt", "matt", "gloss", "gloss", ""]
    np.testing.assert_array_equal(found["layers"].values, [1, 2, 3, 4, np.nan])
    table["make"] = "Seat"
    table.to_csv(path, index=False)
    with pytest.warns(PaintWarning, match="metadata-differ"):
        assert hp.open_library(path)["make"].values[0] == "VW"
    path.with_name("paints.csv.json").unlink()
    with pytest.warns(PaintWarning, match="is missing"):
        found = hp.open_library(path)
    assert set(found["make"].values) == {"Seat"}
    np.testing.assert_array_equal(found["reflectance"].values, library["reflectance"].values)
    assert "n" not in found.variables  # its units are lost
    hp.write_library(found, tmp_path / "again.csv")


@pytest.mark.parametrize(
    ("first", "row", "said"),
    [
        ("signature,make,make,400,500", "a,b,c,1,1", "header-unreadable"),
        ("paint,my make,400,500", "a,b,1,1", "header-unreadable"),
        ("signature,make,400,500", "a,1,1", "row 2.*row-unreadable"),
        ("signature,make,400,500", "a,b,1,x", "row 2: 'a,b,1,x'"),
        ("signature,make,400,-500", "a,b,1,1", "table-missing"),
    ],
)
def test_csv__what_is_no_table_is_said(first: str, row: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(f"{first}\n{row}\n")
    expect_errors((FormatError, said, lambda: hp.open_library(tmp_path / "x.csv")))


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_without_metadata__spectra_and_members_still_lead_back(
    library: xr.Dataset, tmp_path: Path, name: str
) -> None:
    path = hp.write_library(library, tmp_path / name, curves="all")
    path.with_name(path.name + ".json").unlink()
    with pytest.warns(PaintWarning, match="metadata-missing") as noted:
        found = hp.open_library(path)
    assert noted[0].filename == __file__  # the line of the caller
    for variable in ("reflectance", "member_reflectance", "reflectance_quantiles", "reflectance_sd"):
        np.testing.assert_array_equal(found[variable].values, library[variable].values)
        assert found[variable].dims == library[variable].dims
    assert found["signature"].values[0] == ("red; matt" if name.endswith("sli") else "red, matt")
    assert ("make" in found.coords) == name.endswith("csv")


@pytest.mark.parametrize(
    ("separator", "point", "quotes", "tail"),
    [
        (";", ".", csv.QUOTE_MINIMAL, []),
        (";", ",", csv.QUOTE_MINIMAL, []),
        ("\t", ",", csv.QUOTE_MINIMAL, []),
        (",", ".", csv.QUOTE_MINIMAL, ["", ""]),
        (",", ".", csv.QUOTE_ALL, []),
    ],
)
def test_csv_saved_again_by_a_spreadsheet__is_the_same(
    tmp_path: Path, separator: str, point: str, quotes: Any, tail: list[str]
) -> None:
    # Rationale: rows of standard deviations and members became paints, and an empty row too.
    path = hp.write_library(make_library(), tmp_path / "paints.csv", curves="all")
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = [[*row, *tail] for row in csv.reader(file)]
    expected = hp.open_library(path).load()
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, delimiter=separator, quoting=quotes)
        writer.writerows(
            [re.sub(r"^(-?\d+)\.(\d+)", rf"\1{point}\2", cell) for cell in row]
            for row in [*rows, [""] * len(rows[0])]
        )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(?s).*metadata-differ")  # decimal commas in properties
        xr.testing.assert_identical(hp.open_library(path).load(), expected)


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_metadata_of_another_library__are_refused(library: xr.Dataset, tmp_path: Path, name: str) -> None:
    path = hp.write_library(library, tmp_path / name, curves="all")
    other = hp.write_library(
        library.assign_coords(wavelength=library["wavelength"] + 1.0), tmp_path / "other" / name, curves="all"
    )
    path.with_name(path.name + ".json").write_bytes(other.with_name(path.name + ".json").read_bytes())
    expect_errors((FormatError, "grid-mismatch", lambda: hp.open_library(path)))
    fewer = hp.write_library(library.isel(signature=[0, 1]), tmp_path / "fewer" / name, curves="all")
    path.with_name(path.name + ".json").write_bytes(fewer.with_name(path.name + ".json").read_bytes())
    # an axis without values, which an index would fill the memory with
    metadata = json.loads(whole := path.with_name(path.name + ".json").read_text(encoding="utf-8"))
    metadata["coords"]["x"] = {"dims": ["x"], "attrs": {}, "dtype": "float32", "shape": [2**31 - 1]}
    for text, message in ((whole, "sizes"), (json.dumps(metadata), "'x': expected values")):
        path.with_name(path.name + ".json").write_text(text, encoding="utf-8")
        with pytest.raises(FormatError, match=rf"{message}.*metadata-damaged"):
            hp.open_library(path)


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv", "paints.zarr"])
def test_lazy_libraries__are_written_as_loaded_ones(tmp_path: Path, name: str) -> None:
    library = make_library()
    lazy = library.chunk({"signature": 2, "member": 3, "band": 4})
    calls: list[tuple[int, int]] = []
    eager = hp.write_library(
        library, tmp_path / "eager" / name, curves="all", progress=lambda *call: calls.append(call)
    )
    steps, totals = zip(*calls, strict=True)
    assert list(steps) == sorted(steps)
    assert steps[-1] == totals[-1] > 0
    done = hp.write_library(lazy, tmp_path / "lazy" / name, curves="all")
    if not done.is_dir():
        assert files_of(done.parent) == files_of(eager.parent)
    xr.testing.assert_identical(
        hp.open_library(done).load().drop_attrs(), hp.open_library(eager).load().drop_attrs()
    )


def test_units__are_brought_to_those_of_the_table(library: xr.Dataset, tmp_path: Path) -> None:
    # Rationale: percent and micrometres are said by units and converted; no units are an error.
    percent = library[["reflectance"]]
    percent["reflectance"] = (percent["reflectance"] * 100).assign_attrs(units="percent")
    percent["wavelength"] = (percent["wavelength"] / 1e3).assign_attrs(units="um")
    found = hp.open_library(hp.write_library(percent, tmp_path / "paints.sli"))
    np.testing.assert_allclose(found["reflectance"].values, library["reflectance"].values, rtol=1e-6)
    np.testing.assert_allclose(found["wavelength"].values, library["wavelength"].values)
    del percent["reflectance"].attrs["units"]
    expect_errors(
        (SchemaError, r"'reflectance'.*units", lambda: hp.write_library(percent, tmp_path / "more.sli"))
    )


def test_what_cannot_be_written__is_said_all_at_once(library: xr.Dataset, tmp_path: Path) -> None:
    bad = library.drop_vars("wavelength")
    bad["n"] = bad["n"].assign_attrs(units="m")
    with pytest.raises(SchemaError) as caught:
        hp.write_library(bad, tmp_path / "paints.sli")
    expect_words(str(caught.value), "'wavelength' is missing", "'n' has units 'm'")
    broken = library.assign_coords(signature=["a\nb", "c", "d\x00", "e", "f"])
    for format in ("envi", "csv"):
        with pytest.raises(SchemaError, match="name-unwritable"):
            hp.write_library(broken.isel(band=[0, 1]), tmp_path / "paints", format=format)
    for name, options in (
        ("paints.xlsx", {}),
        ("red.spectrum.txt", {}),
        ("paints", {"format": "ecostress"}),
    ):
        with pytest.raises(FormatError, match=r"envi, csv, parquet, zarr.*choice-unknown"):
            hp.write_library(library, tmp_path / name, **options)
    expect_errors(
        (
            SchemaError,
            r"'when'.*type-wrong",
            lambda: hp.write_library(library.assign_attrs(when=object()), tmp_path / "paints.csv"),
        )
    )
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=12)
@given(
    names=st.lists(
        st.text(st.characters(exclude_categories=("Cs", "Cc", "Zl", "Zp")), max_size=12),
        min_size=1,
        max_size=8,
        unique=True,
    ),
    data=st.data(),
)
@pytest.mark.filterwarnings("ignore:.*scale-doubtful")
def test_any_names_and_values__come_back(
    tmp_path_factory: Any, names: list[str], data: st.DataObject
) -> None:
    # Property: names of any characters, and every float32 but infinities.
    value = st.floats(width=32, allow_infinity=False)
    values = data.draw(
        st.lists(st.lists(value, min_size=3, max_size=3), min_size=len(names), max_size=len(names))
    )
    members = data.draw(
        st.lists(st.lists(value, min_size=6, max_size=6), min_size=len(names), max_size=len(names))
    )
    library = xr.Dataset(
        {
            "reflectance": (("signature", "band"), np.array(values, np.float32), {"units": "1"}),
            "member_reflectance": (
                ("signature", "member", "band"),
                np.array(members, np.float32).reshape(-1, 2, 3),
                {"units": "1"},
            ),
        },
        coords={
            "signature": np.array(names, object),
            "wavelength": ("band", [400.0, 500.5, 1 / 3 + 600], {"units": "nm"}),
        },
    )
    for name in ("paints.sli", "paints.csv"):
        xr.testing.assert_identical(
            trip(library, tmp_path_factory.mktemp("any"), name, curves="all"), library
        )


@pytest.mark.parametrize("name", ["paints.sli", "paints.csv"])
def test_signatures_of_a_flight__come_back_whole(tmp_path: Path, name: str) -> None:
    # Rationale: what `extract_signatures` makes holds regions, flags, times and uncertainties as well.
    paints = hp.extract_signatures(painted_lines.made(), painted_lines.TWO, members=5)
    found = trip(paints, tmp_path, name, curves="all")
    assert (set(found.variables), set(found.coords)) == (set(paints.variables), set(paints.coords))
    for variable in paints.variables:
        np.testing.assert_array_equal(found[variable].values, paints[variable].values, err_msg=str(variable))
        assert found[variable].dtype == paints[variable].dtype, variable
        assert dict(found[variable].attrs).keys() == dict(paints[variable].attrs).keys()
    assert found.attrs == paints.attrs


@pytest.mark.real_data
def test_what_is_read_from_others__can_be_written(shared_data: Path, tmp_path: Path) -> None:
    # Rationale: 2,457 names with runs of blanks, wavelengths that fall, missing values, error bars.
    usgs = hp.open_library(shared_data / "envi_sli" / "s07_AV95_envi.sli")
    for name in ("usgs.sli", "usgs.csv"):
        xr.testing.assert_identical(trip(usgs, tmp_path, name, curves="all"), usgs)
    text = hp.open_library(sorted((shared_data / "spectra_ascii").glob("PVC_*.txt")))
    np.testing.assert_array_equal(
        trip(text, tmp_path, "pvc.csv")["reflectance"].values, text["reflectance"].values
    )


@pytest.mark.parametrize("name", ["=HYPERLINK(1)", "+red", "-matt", "@lab", "'=x", "''-y", "-5.25", "'red'"])
def test_no_name_is_a_formula_to_a_spreadsheet(tmp_path: Path, name: str) -> None:
    values = np.array([[0.25, 0.5], [-0.01, 0.75]], np.float32)
    paints = xr.Dataset(
        {"reflectance": (("signature", "band"), values, {"units": "1"})},
        coords={
            "signature": [name, "blue"], "make": ("signature", ["=1+1", "-3"]),
            "wavelength": ("band", [450.0, 650.0], {"units": "nm"}),
        },
    )  # fmt: skip
    path = tmp_path / "paints.csv"
    hp.write_library(paints, path)
    with path.open(newline="") as file:
        cells = [cell for row in csv.reader(file) for cell in row]
    dangerous = [cell for cell in cells if cell[:1] in ("=", "+", "-", "@", "\t", "\r")]
    assert all(float(cell) < 0 for cell in dangerous)  # numbers stay numbers
    back = hp.open_library(path)
    assert back["signature"].values.tolist() == [name, "blue"]
    assert back["make"].values.tolist() == ["=1+1", "-3"]
    np.testing.assert_array_equal(back["reflectance"], paints["reflectance"])


def test_a_wavelength_given_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "twice.csv"
    path.write_text("wavelength (nm),red\n400,0.1\n500,0.2\n600,0.3\n700,0.4\n500,0.25\n800,0.3\n900,0.2\n")
    expect_errors(
        (
            FormatError,
            "wavelength-duplicate",
            lambda: hp.open_library(path, wavelength=[400.0, 500.0, 600.0, 700.0, 500.0, 800.0, 900.0]),
        )
    )


# --- Parquet in the columns of OpenSpecLib: read by pyarrow alone, and files of others ---


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
    assert [row["material.name"] for row in rows] == starter["signature"].values.tolist()
    assert {row["material.category"] for row in rows} == {"man_made"}
    assert json.loads(rows[0]["additional_properties"])["finish"] == "solid"
    np.testing.assert_array_equal(
        np.float32([row["spectral_data.values"] for row in rows]), starter.reflectance.values
    )
    path.with_name("starter.parquet.json").unlink()  # as others hand it on
    with pytest.warns(hp.errors.PaintWarning, match="metadata-missing"):
        alone = hp.open_library(path)
    np.testing.assert_array_equal(alone.reflectance.values, starter.reflectance.values)
    assert alone["signature"].values.tolist() == starter["signature"].values.tolist()


def test_names_of_paints_are_unique(tmp_path):
    starter = hp.paints.starter_library(members=0).isel(signature=[0, 1, 2]).assign_coords(signature=[*"aab"])
    with pytest.warns(hp.errors.PaintWarning, match="paint-duplicate"):
        written = hp.write_library(starter, tmp_path / "p.csv")
    assert hp.open_library(written)["signature"].values.tolist() == ["a", "a (2)", "b"]
    path = tmp_path / "plain.csv"
    path.write_text("wavelength,a,a,b\n450,0.1,0.2,0.3\n550,0.1,0.3,0.3\n650,0.1,0.2,0.4\n")
    with pytest.warns(hp.errors.PaintWarning, match="paint-duplicate"):
        assert hp.open_library(path)["signature"].values.tolist() == ["a", "a (2)", "b"]


def test_wavelengths_out_of_order_are_sorted(tmp_path):
    path, nm = tmp_path / "rolled.csv", np.roll(np.arange(400, 1001, 50), 3)
    path.write_text("wavelength,a\n" + "".join(f"{x},{x / 1e4}\n" for x in nm))
    with pytest.warns(hp.errors.PaintWarning, match="wavelength-unordered"):
        library = hp.open_library(path)
    np.testing.assert_array_equal(library.wavelength, np.sort(nm))
    np.testing.assert_allclose(library.reflectance.values[0], np.sort(nm) / 1e4, rtol=1e-6)


@pytest.mark.parametrize("name", ["p.csv", "p.sli", "p.parquet"])
def test_per_cent_labelled_1_is_told(tmp_path, name):
    starter = hp.paints.starter_library(members=0)
    starter["reflectance"] = 100.0 * starter["reflectance"].assign_attrs(units="1")
    with pytest.warns(hp.errors.PaintWarning, match="scale-doubtful"):
        path = hp.write_library(starter, tmp_path / name)
    with pytest.warns(hp.errors.PaintWarning, match="scale-doubtful"):
        hp.open_library(path)


def test_a_library_by_wavelength_is_written(tmp_path):
    starter = hp.paints.starter_library(members=2)
    path = hp.write_library(starter.swap_dims(band="wavelength"), tmp_path / "p.parquet", curves="all")
    xr.testing.assert_identical(hp.open_library(path), starter)


def test_a_number_beyond_64_bits_is_refused(tmp_path):
    path = hp.write_library(
        hp.paints.starter_library(members=3).isel(signature=[0, 1, 2]), tmp_path / "p.parquet", curves="all"
    )
    # a number beyond 64 bits
    rows = pq.read_table(path)
    keys = [
        text.replace('"place": 2', f'"place": {10**30}') for text in rows["additional_properties"].to_pylist()
    ]
    at = rows.schema.get_field_index("additional_properties")
    pq.write_table(rows.set_column(at, rows.schema.field(at), pa.array(keys)), path)
    expect_errors((hp.FormatError, "record-unmatched", lambda: hp.open_library(path)))
