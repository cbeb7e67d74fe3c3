"""Emissivity files and material lists: the real ones with their known values, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from support.dirsig_exports import specular_fraction
from support.refusals import expect_error, expect_errors

from hyperpaint.base.errors import FormatError, SchemaError
from hyperpaint.io.dirsig import Section, materials_text, open_emissivity, read_emissivity, read_materials
from hyperpaint.io.dirsig.dirsig_files import ColumnText, material_ids, material_names, plain_name

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


def test_an_old_file_is_read_and_all_problems_are_told_at_once(tmp_path: Path) -> None:
    assert read_emissivity(written(tmp_path, OLD)).curves[0].emissivity.tolist() == [0.5] * 396
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


# --- Material lists: the real one with its known values, the grammar, and what is refused ------------------

ENTRY = """MATERIAL_ENTRY {
    ID = a
    NAME = paint a, (matt)

    SURFACE_PROPERTIES {
        EMISSIVITY_PROP_NAME = ClassicEmissivity
        EMISSIVITY_PROP {
            FILENAME = emissivity/a.ems
            SPECULAR_FRACTION = 0.25
        }
    }
}
"""


def written_materials(folder: Path, text: str) -> Path:
    path = folder / "x.mat"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.real_data
def test_the_real_list(shared_data: Path) -> None:
    path = shared_data / "dirsig/anadirsig.mat"
    found = read_materials(path)
    assert [(m.id, m.name, m.emissivity_file, specular_fraction(m)) for m in found] == [
        ("100", "Terrain (remapped)", None, None),
        ("2", "water", "emissivity/muddy_water.ems", 1.0),
        ("4", "grass", "emissivity/grass_texture.ems", 0.1),
        ("13", "dirt", "emissivity/grass_dirt.ems", 1.0),
    ]
    therm = found[1].entry.section("TEMP_SOLVER")
    assert therm is not None
    assert therm.get("THERMAL_CONDUCTIVITY") == "5.13"
    # we write what DIRSIG's people wrote, to the byte
    assert materials_text(material.entry for material in found).encode() == path.read_bytes()


def test_proxies_bundles_and_old_entries(tmp_path: Path) -> None:
    text = ENTRY + "MATERIAL_MAP {\n IMAGE_FILENAME = m.png\n LUT {\n  0:a\n 255 : b\n }\n}\n"
    text += "MATERIAL_ENTRY {\n MATERIAL_ID = 7\n MATERIAL_NAME = old\n EMISSIVITY_FILE = x.ems\n}\n"
    found = read_materials(written_materials(tmp_path, text.replace("\n", "\r\n")))
    assert [(material.id, material.name) for material in found] == [("a", "paint a, (matt)"), ("7", "old")]
    assert specular_fraction(found[0]) == 0.25
    assert found[0].reflectance_file is None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("ID = a", "ID = a b", "id-missing"),
        ("    ID = a\n", "", "id-missing"),
        ("    NAME = paint a, (matt)\n", "", "name-missing"),
        ("ID = a", "ID = a\nID = b", "key-duplicate"),
        ("0.25", "1.5", "SPECULAR_FRACTION = '1.5', expected 0 to 1"),
        ("0.25", "nan", "SPECULAR_FRACTION"),
        ("0.25", "", "SPECULAR_FRACTION"),
        ("NAME = paint", "NAME paint", "line 3"),
        ("MATERIAL_ENTRY {", "MATERIAL_ENTRY\n{", "line 1: 'MATERIAL_ENTRY', expected 'NAME {', '}'"),
        ("    ID = a", "}\n}", "line 3: '}', expected no bracket"),
        ("\n}\n", "\n", "line 1: section MATERIAL_ENTRY is not closed"),
        ("    ID = a", "# no comment", "line 2"),
        ("    ID = a", "0:a", "line 2"),
        ("    EMISSIVITY_PROP {", "    PROP {", "EMISSIVITY_PROP_NAME without a section EMISSIVITY_PROP"),
        ("    ID = a", "A {\n" * 30 + "}\n" * 30, "at most 16 deep"),
    ],
)  # fmt: skip
def test_what_is_refused(old: str, new: str, said: str, tmp_path: Path) -> None:
    assert old in ENTRY
    with pytest.raises(FormatError, match="DIRSIG material list") as caught:
        read_materials(written_materials(tmp_path, ENTRY.replace(old, new, 1)))
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [(ENTRY + ENTRY, "id-duplicate"), ("\n", "section-missing"), ("\n" * 400_001, "400001 lines")],
    ids=["twice", "empty", "long"],
)
def test_ids_and_lines_are_counted(text: str, message: str, tmp_path: Path) -> None:
    expect_errors((FormatError, message, lambda: read_materials(written_materials(tmp_path, text))))


_KEYS = st.from_regex(r"[A-Z][A-Z0-9_]{0,12}", fullmatch=True).filter(lambda key: not key.endswith("_NAME"))
_VALUES = st.text("abcXYZ019 .,/()-", max_size=20).map(str.strip)


@given(st.dictionaries(_KEYS, _VALUES, max_size=6), st.dictionaries(_KEYS, _VALUES, max_size=4))
def test_write_read_write_is_stable(outer: dict[str, str], inner: dict[str, str]) -> None:
    import tempfile

    outer = {key: value for key, value in outer.items() if key != "INNER"}
    items = (("ID", "x"), ("NAME", "n"), *((f"K_{key}", value) for key, value in outer.items()))
    entry = Section("MATERIAL_ENTRY", (*items, Section("INNER", tuple(inner.items()))))
    text = materials_text([entry])
    with tempfile.TemporaryDirectory() as folder:
        read = read_materials(written_materials(Path(folder), text))
    assert (read[0].entry, materials_text([read[0].entry])) == (entry, text)


# --- names -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "plain", "token"),
    [
        ("Türkis, matt", "Tuerkis, matt", "Tuerkis_matt"),
        ("rot/weiß {1}", "rot/weiss _1_", "rot_weiss_1"),
        ("a\nb\tc", "a b c", "a_b_c"),
        ("bleu métallisé", "bleu metallise", "bleu_metallise"),
        ("u\u0308ber", "ueber", "ueber"),
        ("ID = 3 # x", "ID _ 3 _ x", "ID_3_x"),
        ("../../etc/passwd", "../../etc/passwd", "etc_passwd"),
        ("赤", "paint 1", "paint_1"),
        ("", "paint 1", "paint_1"),
        ("42", "42", "paint_42"),
        ("NUL", "NUL", "paint_NUL"),
        ("x" * 300, "x" * 120, "x" * 48),
    ],
)
def test_names_become_plain(name: str, plain: str, token: str) -> None:
    assert (material_names([name]), material_ids([name])) == ([plain], [token])


@given(st.lists(st.text(max_size=12), max_size=12), st.lists(st.text("abAB_ 2()", max_size=4), max_size=6))
def test_no_two_names_or_tokens_are_alike(names: list[str], taken: list[str]) -> None:
    for function in (material_ids, material_names):
        made = function(names, taken)
        folded = [text.casefold() for text in made]
        assert len(set(folded)) == len(names)
        assert not set(folded) & {text.casefold() for text in taken}
        assert all(text.isascii() and text.isprintable() and text.strip() == text for text in made)
        assert not any(sign in text for text in made for sign in "{}=\n")
    assert all(token.replace("_", "a").isalnum() for token in material_ids(names))


def test_a_thousand_names_alike_take_no_long_time() -> None:
    assert (material_ids(["red"] * 5000)[-1], plain_name("a  b")) == ("red_5000", "a b")
