"""Whose paints the scene of a file gets when it is written for DIRSIG."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from hyperpaint.base.errors import SchemaError
from hyperpaint.workflows.rendering import export_dirsig_scene, named_libraries

NM = np.linspace(400.0, 1000.0, 31)
SCENE = """
[scene]
kind = "car_park"
fleet = "solid"
length_m = 12.0
neighbours = []
seed = 3
[platform]
lines = 4
columns = 4
altitude_m = 15.0
ground_sample_m = 0.1
"""


def library(*names: str) -> xr.Dataset:
    values = np.linspace(0.1, 0.5, len(names))[:, None] * np.ones_like(NM)
    return xr.Dataset(
        {"reflectance": (("signature", "band"), values.astype(np.float32), {"units": "1"})},
        {"signature": list(names), "wavelength": ("band", NM, {"units": "nm"})},
    )


def exported(tmp_path: Path, text: str, paints: xr.Dataset | None = None) -> dict[str, int]:
    (tmp_path / "scene.toml").write_text(text)
    summary = export_dirsig_scene(tmp_path / "scene.toml", tmp_path / "out", paints)
    return dict(zip(summary["signature"].values.tolist(), summary["faces"].values.tolist(), strict=True))


def test_foreign_names_are_dealt_to_the_cars(tmp_path: Path) -> None:
    faces = exported(tmp_path, SCENE, library("roof 7", "roof 8"))
    assert faces["roof 7"] > 0
    assert faces["roof 8"] > 0
    assert "asphalt" in faces


def test_without_a_library_the_built_in_spectra_are_written(tmp_path: Path) -> None:
    assert {"asphalt", "glass"} <= exported(tmp_path, SCENE).keys()


def test_a_file_of_two_columns_repaints(tmp_path: Path) -> None:
    rows = "".join(f"{nm:.1f},0.3\n" for nm in NM)
    (tmp_path / "mine.csv").write_text("wavelength,reflectance\n" + rows)
    faces = exported(tmp_path, SCENE + '[spectra]\nmine = "mine.csv"\n[paints]\nasphalt = "mine"\n')
    assert faces["mine"] > 0
    assert "asphalt" not in faces


def test_paints_of_libraries_in_a_file_have_its_names() -> None:
    spectra: dict[str, Any] = {"mine": library("a", "b"), "one": library("c"), "flat": (NM, NM)}
    names = [each["signature"].values.tolist() for each in named_libraries(spectra)]
    assert names == [["mine/a", "mine/b"], ["one/c"], ["one"]]


def test_an_unknown_paint_is_named(tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match="'no such paint'"):
        exported(tmp_path, SCENE + '[paints]\nasphalt = "no such paint"\n')
