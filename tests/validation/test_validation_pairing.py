"""Which readings belong together: of one name, one folder and one instrument."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.agreeing_spectra import NM, agreeing, field, library, seen
from support.refusals import expect_refusals

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError

FIELD_NM = np.arange(380.0, 1021.0)
LEVEL = seen(FIELD_NM, 3.0)


def red() -> xr.Dataset:
    # Return a library of one paint, red
    return library(seen(NM, 6.0), ("red",))


def write_sig(path: Path, level: float, head: str = "") -> None:
    rows = "".join(
        f"{nm:.1f}  8000.00  {8000 * level:.2f}  {100 * level:.2f}\n" for nm in np.arange(350, 1050, 1.5)
    )
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"/*** Spectra Vista SIG Data ***/\n{head}units= Radiance, Radiance\ndata= \n{rows}")


def test_files_of_one_name_in_two_folders_are_no_repeats() -> None:
    two = field([LEVEL + 0.2, LEVEL - 0.2], ["site1/red.sig", "site2/red.sig"])
    expect_refusals(
        (SchemaError, "reference-ambiguous", "site1/red", "site2/red", lambda: hp.validate(red(), two))
    )
    assert hp.validate(red(), two, {"red": "site1/red"}).statistics["reference"].values.tolist() == [
        "site1/red.sig"
    ]
    with pytest.warns(PaintWarning, match="reference-scatter"):
        both = hp.validate(red(), two, {"red": ["site1/red.sig", "site2/red.sig"]})
    assert any("show one paint" in note for note in both.notes[0])


def test_a_short_name_of_two_datasets_is_refused() -> None:
    one, other = field(LEVEL + 0.2, ["red"]), field(LEVEL - 0.2, ["red"])
    expect_refusals(
        (SchemaError, "reference-ambiguous", "dataset 2", lambda: hp.validate(red(), [one, other]))
    )


def test_full_names_go_before_short_ones() -> None:
    found = hp.validate(red(), field([LEVEL, LEVEL + 0.3], ["red", "other/red.sig"]))
    assert (found.statistics["reference"].values.tolist(), found.unpaired_references) == (
        ["red"],
        (("other/red.sig (ASD)",)),
    )
    # each instrument for itself
    assert hp.validate(
        red(), [field(LEVEL, ["red"]), field(LEVEL, ["svc/red.sig"], instrument="SVC")]
    ).statistics["reference"].values.tolist() == ["red", "svc/red.sig"]


def test_readings_of_one_folder_are_repeats() -> None:
    assert hp.validate(red(), field([LEVEL, LEVEL], ["red", "red"])).statistics[
        "reference"
    ].values.tolist() == ["red, red"]


def test_files_of_open_svc(tmp_path: Path) -> None:
    for folder, level in (("site1", 0.5), ("site2", 0.1)):
        write_sig(tmp_path / folder / "red.sig", level, "time= 27.05.2025 09:39:32, 27.05.2025 09:42:59\n")
    both = hp.open_svc([tmp_path / "site1", tmp_path / "site2"], utc_offset_h=2)
    paints = library(np.full(NM.size, 0.3), ("red",))
    expect_refusals((SchemaError, "reference-ambiguous", "site2/red", lambda: hp.validate(paints, both)))
    for name in ("site1/red", "site1/red.sig"):
        assert float(
            hp.validate(paints, both, {"red": name}).statistics["bias"].sel(part="all").item()
        ) == pytest.approx(-0.2, abs=1e-3)
    # folders of one name, which the reader numbers
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_sig(
            tmp_path / folder / "svc" / "red.sig", 0.3, "time= 27.05.2025 09:39:32, 27.05.2025 09:42:59\n"
        )
    numbered = hp.open_svc([tmp_path / "a" / "svc", tmp_path / "b" / "svc"], utc_offset_h=2)
    expect_refusals((SchemaError, "reference-ambiguous", "red (2)", lambda: hp.validate(paints, numbered)))


def test_instruments_of_one_make_are_compared_apart(tmp_path: Path) -> None:
    times = "time= 27.05.2025 09:39:32, 27.05.2025 09:42:59\n"
    for serial, level in ((1, 0.31), (2, 0.29)):
        write_sig(
            tmp_path / f"s{serial}" / "red.sig",
            level,
            f"instrument= HI: {serial} (HR-1024i)\nerror= 0, {serial}\n{times}",
        )
    both = hp.open_svc([tmp_path / "s1", tmp_path / "s2"], utc_offset_h=2)
    with pytest.warns(PaintWarning, match=r"HI: 2.*references-disagree"):
        found = hp.validate(library(np.full(NM.size, 0.3), ("red",)), both)
    assert found.statistics["instrument"].values.tolist() == ["SVC HI: 1 (HR-1024i)", "SVC HI: 2 (HR-1024i)"]
    np.testing.assert_allclose(found.statistics["bias"].sel(part="all"), [-0.01, 0.01], atol=1e-4)
    assert "the instrument set error bits 1 in the target scan" in found.notes[0]
    assert "the instrument set error bits 2 in the target scan" in found.notes[1]
    # one alone needs no number
    assert hp.validate(library(np.full(NM.size, 0.3), ("red",)), both.isel(spectrum=[0])).statistics[
        "instrument"
    ].values.tolist() == ["SVC"]


def test_paints_of_one_name_are_refused() -> None:
    paints = library([seen(NM, 6.0)] * 2, ("hood", "hood"))
    with pytest.raises(SchemaError) as refused:
        hp.validate(paints, agreeing()[1])
    assert refused.value.codes == ("paint-duplicate",) * 2
    # each names its own
    assert (
        hp.validate(
            paints.assign_coords(reference=("signature", np.array(["a", "b"], object))),
            field([LEVEL] * 2, ["a", "b"]),
        ).statistics.sizes["pair"]
        == 2
    )


def test_a_relative_reference_without_its_panel_is_told() -> None:
    signatures, references = agreeing()
    told = "the reference is relative to a white panel, the signature is absolute"
    assert any(
        told in note and "pass panel=" in note for note in hp.validate(signatures, references).notes[0]
    )
    absolute = references.assign(
        reflectance=references["reflectance"].assign_attrs(reflectance_scale="absolute")
    )
    assert not any("white panel" in note for note in hp.validate(signatures, absolute).notes[0])
    assert any(
        "the signature is relative to a white panel" in note
        for note in hp.validate(
            signatures.assign(
                reflectance=signatures["reflectance"].assign_attrs(reflectance_scale="relative")
            ),
            absolute,
        ).notes[0]
    )
