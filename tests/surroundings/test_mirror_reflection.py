"""The attribute that says whether reflectance holds what a clear coat mirrors, from pixel to simulator."""

from pathlib import Path

import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.simulation import simulate_line


@pytest.fixture(scope="module")
def line() -> xr.Dataset:
    return hp.reflectance(simulate_line(lines=32, bands=40, columns=24, smile_nm=0.0))


@pytest.fixture(scope="module")
def regions() -> hp.Regions:
    return hp.Regions((hp.Region("grass", [(0, 0), (0, 31), (0.4, 31), (0.4, 0)]),))


def told(library: xr.Dataset) -> object:
    return library.reflectance.attrs["mirror_reflection"]


def test_signatures_say_it(line: xr.Dataset, regions: hp.Regions, tmp_path: Path) -> None:
    seen = hp.extract_signatures(line, regions)
    removed = hp.extract_signatures(line, regions, specular_sky=True, sun_zenith=40.0, diffuse="model")
    afterwards = hp.surroundings.remove_mirrored_sky(seen, sun_zenith=40.0)
    before = hp.extract_signatures(
        hp.surroundings.remove_mirrored_sky(line, sun_zenith=40.0, diffuse="model"), regions
    )
    assert [told(each) for each in (seen, removed, afterwards, before)] == ["included", *["excluded"] * 3]
    made = hp.write_dirsig(afterwards, tmp_path / "dirsig", specular=0.02)
    assert made.attrs["mirror_reflection"] == "excluded"
    with pytest.raises(SchemaError, match="coat-counted-twice"):
        hp.write_dirsig(seen, tmp_path / "twice", specular=0.02)
    lines = {"a": line, "b": hp.surroundings.remove_mirrored_sky(line, sun_zenith=40.0, diffuse="model")}
    corners = [(0, 0), (0, 31), (0.4, 31), (0.4, 0)]
    both = hp.Regions(tuple(hp.Region(f"grass {name}", corners, flightline=name) for name in lines))
    assert told(hp.extract_signatures(lines, both)) == "included"
    body = hp.surroundings.remove_mirrored_sky(hp.extract_signatures(line, regions), sun_zenith=40.0)
    darker = hp.paints.shade_paints(body, [2.0])
    assert told(darker) == "excluded"
    assert (darker.reflectance <= body.reflectance.clip(min=1e-3).values).all()
    assert told(hp.paints.sample_paints(body, 5)) == "excluded"
