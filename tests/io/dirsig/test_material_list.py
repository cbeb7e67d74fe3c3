"""Material lists: the real one with its known values, the grammar, and what is refused."""

from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st
from support.refusals import expect_errors

from hyperpaint.base.errors import FormatError
from hyperpaint.io.dirsig import Section, materials_text, read_materials
from hyperpaint.io.dirsig.dirsig_files import material_ids, material_names, plain_name

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


def written(folder: Path, text: str) -> Path:
    path = folder / "x.mat"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.real_data
def test_the_real_list(shared_data: Path) -> None:
    path = shared_data / "dirsig/anadirsig.mat"
    found = read_materials(path)
    assert [(m.id, m.name, m.emissivity_file, m.specular_fraction) for m in found] == [
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
    found = read_materials(written(tmp_path, text.replace("\n", "\r\n")))
    assert [(material.id, material.name) for material in found] == [("a", "paint a, (matt)"), ("7", "old")]
    assert found[0].specular_fraction == 0.25
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
        read_materials(written(tmp_path, ENTRY.replace(old, new, 1)))
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [(ENTRY + ENTRY, "id-duplicate"), ("\n", "section-missing"), ("\n" * 400_001, "400001 lines")],
    ids=["twice", "empty", "long"],
)
def test_ids_and_lines_are_counted(text: str, message: str, tmp_path: Path) -> None:
    expect_errors((FormatError, message, lambda: read_materials(written(tmp_path, text))))


_KEYS = st.from_regex(r"[A-Z][A-Z0-9_]{0,12}", fullmatch=True).filter(lambda key: not key.endswith("_NAME"))
_VALUES = st.text("abcXYZ019 .,/()-", max_size=20).map(str.strip)


@settings(max_examples=40)
@given(st.dictionaries(_KEYS, _VALUES, max_size=6), st.dictionaries(_KEYS, _VALUES, max_size=4))
def test_write_read_write_is_stable(outer: dict[str, str], inner: dict[str, str]) -> None:
    import tempfile

    outer = {key: value for key, value in outer.items() if key != "INNER"}
    items = (("ID", "x"), ("NAME", "n"), *((f"K_{key}", value) for key, value in outer.items()))
    entry = Section("MATERIAL_ENTRY", (*items, Section("INNER", tuple(inner.items()))))
    text = materials_text([entry])
    with tempfile.TemporaryDirectory() as folder:
        read = read_materials(written(Path(folder), text))
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


@settings(max_examples=60)
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
