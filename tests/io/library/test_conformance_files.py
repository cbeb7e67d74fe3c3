"""Conformance files of the paint library: right ones, one a format, and faulty ones that name their rule.

Whoever writes another reader or checker tries it on them. They change with the version of the specification
alone: what is written today has their bytes. ``python`` and the path of this file wrote them.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # where this is run as a script

from support.library_examples import declared_library

import hyperpaint as hp

FILES = Path(__file__).with_name("conformance")
WHOLE = ("three_paints.csv", "three_paints.sli", "three_paints.parquet")  # nothing is lost
#: What is put into the attributes of the library; every rule finds its own.
FAULTY = {
    "version": {"paint_library_version": None},
    "title": {"title": ""},
    "quantity": {"quantity": "albedo"},
    "specular_component": {"specular_component": "perhaps"},
    "measurement_geometry": {"measurement_geometry": None},
    "provenance": {"provenance": "bought"},
    "licence": {"licence": None},
    "contradiction": {"quantity": "8/d SCI", "specular_component": "excluded"},
}


def write(folder: Path) -> None:
    library = declared_library(bands=6)
    for name in WHOLE:
        hp.write_library(library, folder / name, curves="all")
    (folder / "faulty").mkdir()
    for rule, words in FAULTY.items():
        attrs = {key: word for key, word in {**library.attrs, **words}.items() if word is not None}
        faulty = library.copy()
        faulty.attrs = attrs
        hp.write_library(faulty, folder / "faulty" / f"{rule}.csv", curves="all")


@pytest.mark.parametrize("name", WHOLE)
def test_right_files_are_one_library(name: str) -> None:
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    xr.testing.assert_identical(hp.open_library(FILES / name), declared_library(bands=6))
    assert hp.io.check_library(FILES / name).ok


def test_texts_of_0_2_open() -> None:
    # Rationale: hyperpaint 0.2 wrote these texts in the format of the ECOSTRESS library.
    library, back = declared_library(bands=6), hp.open_library(sorted((FILES / "ecostress").glob("*.txt")))
    np.testing.assert_allclose(
        back.reflectance, library.reflectance.sel(signature=back["signature"].values), rtol=1e-6
    )


@pytest.mark.parametrize("rule", FAULTY)
def test_faulty_files_are_found_by_their_rule(rule: str) -> None:
    report = hp.io.check_library(FILES / "faulty" / f"{rule}.csv")
    assert {finding.rule for finding in report.findings} == {rule}, str(report)


def test_what_is_written_today_has_their_bytes(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    write(tmp_path)
    stored = {path.relative_to(FILES) for path in FILES.rglob("*") if path.is_file()}
    stored -= {path for path in stored if path.parts[0] == "ecostress"}
    assert {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()} == stored
    for name in sorted(stored):
        if name.suffix != ".parquet":  # its bytes are those of pyarrow's version
            assert (tmp_path / name).read_bytes() == (FILES / name).read_bytes(), name
    assert json.loads((FILES / "three_paints.csv.json").read_text(encoding="utf-8"))


if __name__ == "__main__":
    FILES.mkdir()
    write(FILES)
