"""A folder of a line scanner, from `init` to signatures: raw, white and dark, and nothing else."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint.base.errors import CollectError, PaintWarning
from hyperpaint.workflows.field_day import run_field_day
from hyperpaint.workflows.field_folder import find_field_files, unknown_keys, write_collect_toml

BANDS, COLUMNS, TILE = 6, 20, 0.97
RNG = np.random.default_rng(3)
FIXED = RNG.normal(100.0, 3.0, (BANDS, COLUMNS))
RESPONSE = RNG.uniform(1500.0, 3500.0, (BANDS, COLUMNS))


def write(
    path: Path, reflectance: float, clock: str, lines: int = 30, lamp: float = 1.0, scene: int | None = None
) -> None:
    # a cube of an even surface, with the header of a Specim camera; without a clock as of another camera
    path.parent.mkdir(parents=True, exist_ok=True)
    # after ``scene`` lines of the scene follow dark lines
    mean = np.tile(lamp * reflectance * RESPONSE, (lines, 1, 1))
    mean[scene or lines :] = 0.0
    own_dark = f"autodarkstartline = {scene}\n" if scene else ""
    counts = np.rint(FIXED + RNG.normal(mean, np.sqrt(mean / 40.0 + 1.5))).clip(0, 4095)
    counts.astype("u2").tofile(path.with_suffix(".raw"))
    clock = clock and f"acquisition date = DATE(yyyy-mm-dd): 2024-06-14\nStart Time = UTC TIME: {clock}\n"
    clock = clock and f"{clock}fps = 50.00\n"
    nm = ", ".join(f"{500 + 50 * band}" for band in range(BANDS))
    path.with_suffix(".hdr").write_text(
        f"ENVI\n{clock}{own_dark}samples = {COLUMNS}\nbands = {BANDS}\nlines = {lines}\ninterleave = bil\n"
        f"data type = 12\nheader offset = 0\nbyte order = 0\ntint = 9.00\nwavelength = {{{nm}}}\n"
    )


@pytest.mark.parametrize("clocks", [("09:46:00", "09:47:00", "09:48:00"), ("", "", "")])
def test_a_folder_of_a_line_scanner_is_processed(tmp_path: Path, clocks: tuple[str, str, str]) -> None:
    capture = tmp_path / "day/lot1/capture"
    before, during, after = clocks
    if during:
        write(capture / "lot1", 0.4, during, 40, lamp=0.98)
        write(capture / "DARKREF_lot1", 0.0, during)
    else:
        write(capture / "lot1", 0.4, during, 70, scene=40)
    write(capture / "WHITEREF_lot1", TILE, before)
    if after:
        write(capture / "WHITEREF_end", TILE, after, lamp=0.96)
    found = find_field_files(tmp_path / "day")
    assert [path.stem for path in found.whites] == ["WHITEREF_end", "WHITEREF_lot1"][not after :]
    toml = write_collect_toml(found)
    assert unknown_keys(toml) == ['reflectance = "?"']
    expect_error(CollectError, "reflectance", lambda: hp.open_collect(toml))
    toml.write_text(
        toml.read_text().replace('reflectance = "?"', f"reflectance = {TILE}\nuncertainty = 0.01")
    )
    regions = hp.Regions([hp.Region("grey", [(2, 2), (17, 2), (17, 37), (2, 37)], flightline="lot1")])
    hp.write_regions(regions, tmp_path / "regions.geojson")
    # flags of the lamp are told; without them, steps of other tests are left out
    skip = () if after else ("dirsig", "report")
    with pytest.warns(PaintWarning, match="illumination_unstable") if after else nullcontext():
        day = run_field_day(toml, tmp_path / "out", regions=tmp_path / "regions.geojson", skip=skip)
    assert not day.errors
    line = hp.open_store(tmp_path / "out/lot.zarr", "flightlines/lot1")
    assert ("time" in line.coords) == bool(during)
    assert float(line.reflectance.mean()) == pytest.approx(0.4, rel=2e-3)
    np.testing.assert_allclose(line.paint.reflectance().reflectance, line.reflectance, rtol=2**-12)
    paint = hp.open_library(tmp_path / "out/paints.zarr")
    assert paint.reflectance.values == pytest.approx(np.full((1, BANDS), 0.4), rel=4e-3)
    assert paint.reflectance_u_systematic.values == pytest.approx(np.full((1, BANDS), 0.004), rel=0.1)
