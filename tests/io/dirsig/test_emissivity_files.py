"""Spectral emissivity files: the real ones with their known values, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from support.refusals import expect_error, expect_errors

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.io.dirsig import open_emissivity, read_emissivity
from hyperpaint.io.dirsig.dirsig_files import ColumnText

NEW = [
    "2",
    *["1.0"] * 91,
    "CURVE_BEGIN\t",
    "0.4\t0.9",
    "0.5\t0.8",
    "CURVE_BEGIN",
    "0.4 0.7",
    "0.6 1e-1",
    "",
    " ",
]
OLD = ["1", *["1.0"] * 91, "0", *(f"{wave} 0.5" for wave in range(39850, 349, -100))]


def written(folder: Path, lines: list[str], end: str = "\n") -> Path:
    path = folder / "paint.ems"
    path.write_bytes(end.join(lines).encode())
    return path


# --- real files --------------------------------------------------------------------------------------------


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "layout", "count", "rows", "ends", "values"),
    [
        ("muddy_water", "old", 1, 396, (1e4 / 39850, 1e4 / 350), (0.95943, 1.0)),
        ("grass_texture", "old", 43, 396, (1e4 / 39850, 1e4 / 350), (0.494154, 1.0)),
        ("ideal_mat_1", "new", 1, 3879, (0.35, 14.983), (1.0, 1.0)),
        ("ideal_mat_2", "new", 1, 3879, (0.35, 14.983), (0.9, 0.9)),
        ("background_1", "new", 1, 3879, (0.35, 14.983), (0.98, 0.98)),
    ],
)
def test_real_files(name, layout, count, rows, ends, values, shared_data: Path) -> None:
    found = read_emissivity(shared_data / "dirsig" / "emissivity" / f"{name}.ems")
    assert (found.layout, len(found.curves), found.weights.shape) == (layout, count, (91,))
    assert {len(curve.wavelength) for curve in found.curves} == {rows}
    all_values = np.concatenate([curve.emissivity for curve in found.curves])
    assert (all_values.min(), all_values.max()) == values
    np.testing.assert_allclose(found.curves[0].wavelength[[0, -1]], ends, rtol=0, atol=0)
    assert (np.diff(found.curves[0].wavelength) > 0).all()


@pytest.mark.real_data
def test_water_shines_less_at_the_horizon(shared_data: Path) -> None:
    weights = read_emissivity(shared_data / "dirsig/emissivity/muddy_water.ems").weights
    assert (weights[:3].tolist(), weights[90]) == ([1.0, 0.995893, 0.991786], 0.0)


@pytest.mark.real_data
def test_grass_as_a_paint_library(shared_data: Path) -> None:
    grass = open_emissivity(shared_data / "dirsig/emissivity/grass_texture.ems")
    assert dict(grass.sizes) == {"signature": 1, "band": 396, "member": 43}
    assert grass.member_reflectance.dtype == grass.reflectance.dtype == np.float32
    assert (grass["signature"].item(), grass.wavelength.attrs["units"]) == ("grass_texture", "nm")
    # the last row of the file, by hand: 350 cm-1, emissivity 0.950167
    np.testing.assert_allclose(grass.wavelength[-1], 1e7 / 350)
    np.testing.assert_allclose(grass.member_reflectance[0, -1, -1], 1 - 0.950167, atol=1e-7)


# --- what is read and what is refused ----------------------------------------------------------------------


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_new_file_may_have_tabs_and_blank_lines(tmp_path: Path, end: str) -> None:
    found = read_emissivity(written(tmp_path, NEW, end))
    assert [curve.wavelength.tolist() for curve in found.curves] == [[0.4, 0.5], [0.4, 0.6]]
    assert [curve.emissivity.tolist() for curve in found.curves] == [[0.9, 0.8], [0.7, 0.1]]
    expect_errors((FormatError, "grid-mismatch", lambda: open_emissivity(tmp_path / "paint.ems")))
    # the last line needs no end
    assert len(read_emissivity(written(tmp_path, NEW[:-2])).curves) == 2


@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        (0, "3", "2 curves, expected 3"),
        (0, "1", "2 curves, expected 1"),
        (0, "0", "line 1: '0', expected a number of curves"),
        (0, "1e3", "line 1: '1e3'"),
        (0, "99999999999", "line 1"),
        (5, "one", "line 6: 'one', expected the weight of 4 degrees"),
        (5, "-1", "negative"),
        (5, "1e400", "value-out-of-range"),
        (5, "1.0 1.0", "line 6"),
        (92, "CURVE", "line 93: 'CURVE', expected CURVE_BEGIN or the number 0"),
        (93, "0.4", "line 94: '0.4', expected two numbers"),
        (93, "0.4 0.9 0.8", "line 94"),
        (93, "0,4 0,9", "line 94"),
        (93, "nan 0.9", "line 94"),
        (93, "0.6 0.9", "curve 0, from line 94: wavelengths do not ascend"),
        (93, "0.5 0.9", "do not ascend"),
        (93, "0 0.9", "do not ascend"),
        (94, "500 0.9", "up to 500, expected micrometres"),
        (94, "0.5 90", "emissivity from 0.9 to 90"),
        (94, "0.5 -0.1", "expected 0 to 1"),
        (94, "0.5 1e999", "expected 0 to 1"),
        (97, "0.6 0x1", "line 98"),
        (98, "and so on", "line 99: 'and so on'"),
        # the old layout
        (92, "1", "line 93: curve 1, expected 0"),
        (93, "39849 0.5", "396 wavenumbers"),
        (100, "", "line 101"),
        (100, "0.5", "line 101"),
        (487, "450 0.5\n350 0.5", "397 rows, expected the 396"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused(line: int, text: str, said: str, tmp_path: Path) -> None:
    lines = OLD.copy() if ((line, text) in [(92, "1"), (93, "39849 0.5")] or line > 99) else NEW.copy()
    lines[line] = text
    error = expect_error(FormatError, "DIRSIG emissivity", lambda: read_emissivity(written(tmp_path, lines)))
    assert said in str(error)


def test_an_old_file_is_read(tmp_path: Path) -> None:
    assert read_emissivity(written(tmp_path, OLD)).curves[0].emissivity.tolist() == [0.5] * 396


def test_all_problems_are_told_at_once(tmp_path: Path) -> None:
    lines = NEW.copy()
    lines[94], lines[96] = "0.5 7", "x"
    error = expect_error(FormatError, None, lambda: read_emissivity(written(tmp_path, lines)))
    assert str(error).count("\n") == 2


@pytest.mark.parametrize("data", [b"", b"\n", b"1\n", b"1\n" * 93, b"\xff\xfe\x00", b"9" * 100_000])
def test_what_is_no_such_file_is_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.ems"
    path.write_bytes(data)
    expect_errors(
        (FormatError, r"x\.ems", lambda: read_emissivity(path)),
        (FormatError, "file-unreadable", lambda: read_emissivity(tmp_path / "missing.ems")),
    )


# --- text --------------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(
    st.lists(st.floats(0.01, 99_000), min_size=1, max_size=12, unique_by=lambda nm: round(nm, 2)),
    st.integers(1, 4),
    st.randoms(use_true_random=False),
)
def test_text_is_what_formatting_one_by_one_gives(wavelength, count, random) -> None:
    wavelength = sorted(wavelength)
    # whole millionths and their neighbours; halves may round either way
    values = np.array(
        [[random.choice((0.0, 1.0, random.random())) for _ in wavelength] for _ in range(count)]
    )
    expected = "".join(
        "TITLE\n"
        + "".join(f"{nm / 1000:.7f}\t{value:.6f}\n" for nm, value in zip(wavelength, row, strict=True))
        for row in values
    )
    assert ColumnText(wavelength, "TITLE").text(values) == expected.encode()


def test_wavelengths_that_are_written_alike_are_refused() -> None:
    expect_errors((SchemaError, "wavelength-unordered", lambda: ColumnText([400.0, 400.00001])))
