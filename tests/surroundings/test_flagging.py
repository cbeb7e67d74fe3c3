"""Lines that nobody has flagged are flagged before signatures and reports; others keep their flags."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner, Result

import hyperpaint as hp
from hyperpaint import surroundings as scene_model
from hyperpaint.base import schema
from hyperpaint.base.schema import Quality
from hyperpaint.cli.program import main
from hyperpaint.light.sun import diffuse_fraction, solar_position
from hyperpaint.regions import proposals
from hyperpaint.regions.proposals import Proposals
from hyperpaint.report import store_report
from hyperpaint.simulation import simulate_line
from hyperpaint.surroundings import surveying
from hyperpaint.surroundings.surveying import flag_line, is_flagged
from hyperpaint.workflows import field_day
from hyperpaint.workflows.field_day import write_signatures

LINES, BANDS, COLUMNS = 48, 24, 40
NM = np.linspace(420.0, 980.0, BANDS)
HOOD = hp.Region("hood", [(10, 10), (29, 10), (29, 37), (10, 37)], flightline="raw_0")
LOOKED_FOR = Quality.GLINT | Quality.SHADOW | Quality.ADJACENCY | Quality.MIXED_EDGE


def scene(*, placed: bool = True) -> xr.Dataset:
    # Return a red panel on asphalt whose middle mirrors the sun
    time = np.datetime64("2020-06-21T15:19:00", "ns") + np.arange(LINES) * np.timedelta64(7, "ms")
    zenith = float(solar_position(time[0], 43.08, -77.67)[0]) if placed else 30.0
    seen = np.full((LINES, BANDS, COLUMNS), 0.1)
    seen[5:43, :, 5:35] = np.where(NM > 600.0, 0.5, 0.05)[:, None]
    y, x = np.mgrid[:LINES, :COLUMNS]
    mirrored = 4.0 * np.exp(-((y - 23) ** 2 + (x - 20) ** 2) / 8.0)
    seen += mirrored[:, None, :] * (1.0 - diffuse_fraction(NM, zenith))[:, None]
    line = xr.Dataset(
        {"reflectance": (("along_track", "band", "cross_track"), seen.astype("f4"), {"units": "1"})},
        {"wavelength": ("band", NM, {"units": "nm"})},
        {"name": "raw_0"},
    )
    line["quality"] = schema.label(
        xr.DataArray(np.zeros((LINES, COLUMNS), np.uint16), dims=("along_track", "cross_track")), "quality"
    )
    if placed:
        place = {"latitude": 43.08, "longitude": -77.67}
        line = line.assign_coords(time=("along_track", time))
        line = line.assign_coords(
            {k: ("along_track", np.full(LINES, v), {"units": "degree"}) for k, v in place.items()}
        )
    return line


def stored(line: xr.Dataset, folder: Path) -> Path:
    hp.to_store(line, folder / "lot.zarr", "flightlines/raw_0")
    return folder / "lot.zarr"


@pytest.fixture(scope="module")
def lot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stored(scene(), tmp_path_factory.mktemp("flagging"))


def run(*words: object) -> Result:
    return CliRunner().invoke(main, [*map(str, words)])


@pytest.fixture
def surveys(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    # Return the options of every survey that is made
    made: list[dict[str, Any]] = []
    real = scene_model.survey

    def watched(line: xr.Dataset, **options: Any) -> Any:
        made.append(options)
        return real(line, **options)

    for module in (surveying, proposals):
        monkeypatch.setattr(module, "survey", watched)
    return made


def test_who_has_been_looked_at(tmp_path: Path, no_compute: Callable[[], Any]) -> None:
    line = scene()
    assert not is_flagged(line)
    assert not is_flagged(line.drop_vars("quality"))
    flagged = line.paint.flag()
    with no_compute():
        assert is_flagged(flagged)
    nothing = flagged.quality.where(False, 0).astype(np.uint16).assign_attrs(flagged.quality.attrs)
    assert is_flagged(line.assign(quality=nothing))  # looked for, nothing found
    bits = line.quality.copy()
    bits[3, 4] = int(Quality.SHADOW)
    assert is_flagged(line.assign(quality=bits))
    bits[3, 4] = int(Quality.SATURATED | Quality.LOW_SUN)
    assert not is_flagged(line.assign(quality=bits))
    assert is_flagged(hp.open_store(stored(flagged.compute(), tmp_path), "flightlines/raw_0"))


@pytest.mark.slow
def test_the_command_flags_first(lot: Path, tmp_path: Path, surveys: list[dict[str, Any]]) -> None:
    regions = hp.write_regions(hp.Regions((HOOD,)), tmp_path / "r.geojson")
    done = run("signatures", lot, "--regions", regions, "--out", tmp_path / "a.zarr")
    assert done.exit_code == 0, done.output
    assert len(surveys) == 1
    plain = run("signatures", lot, "--regions", regions, "--out", tmp_path / "b.zarr", "--no-flags")
    assert plain.exit_code == 0, plain.output
    assert len(surveys) == 1
    flagged, unflagged = (xr.open_zarr(tmp_path / name).load() for name in ("a.zarr", "b.zarr"))
    glint = float(flagged.quality_share.sel(flag="glint")[0])
    assert 0.03 < glint < 0.4
    assert int(flagged.n_excluded[0]) >= round(560 * glint) > 20
    assert (int(unflagged.n_excluded[0]), float(unflagged.quality_share.sum())) == (0, 0)
    assert "clear sky of hyperpaint.light.sun" in flagged.attrs["flags"]
    assert unflagged.attrs["flags"] == "not looked for"
    # the same as by hand
    by_hand = hp.open_store(lot, "flightlines/raw_0").paint.flag().paint.signatures(hp.Regions((HOOD,)))
    for name in by_hand.data_vars:
        assert by_hand[name].values.tobytes() == flagged[name].values.tobytes(), name


def test_the_sun_is_asked_for(tmp_path: Path, surveys: list[dict[str, Any]]) -> None:
    nowhere = stored(scene(placed=False), tmp_path)
    regions = hp.write_regions(hp.Regions((HOOD,)), tmp_path / "r.geojson")
    out = tmp_path / "a.zarr"
    done = run("signatures", nowhere, "--regions", regions, "--out", out)
    assert done.exit_code == 2
    assert "give --sun-zenith" in done.stderr
    assert (
        "flight line 'raw_0' has no flags of glint or shadow; --no-flags extracts without them" in done.stderr
    )
    assert not out.exists()
    done = run(
        "signatures", nowhere, "--regions", regions, "--out", out, "--sun-zenith", 30,
        "--set", "diffuse=model", "--set", "glint=999", "--specular-sky",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert (surveys[-1]["sun_zenith"], surveys[-1]["diffuse"]) == (30.0, "model")
    found = xr.open_zarr(out).load()
    assert float(found.quality_share.sel(flag="glint")[0]) == 0.0  # the threshold was passed on
    assert "sun zenith 30 degree" in found.attrs["corrections"]
    refused = run(
        "signatures", nowhere, "--regions", regions, "--out", out, "--no-flags", "--set", "glint=0.1"
    )
    assert refused.exit_code == 2
    assert "option-conflict" in refused.stderr


def test_flags_of_the_store_stay(tmp_path: Path, surveys: list[dict[str, Any]]) -> None:
    line = scene()
    line["quality"][10:38, 10:14] = int(Quality.SHADOW)
    made = write_signatures(stored(line, tmp_path), hp.Regions((HOOD,)), tmp_path / "a.zarr")
    assert not surveys
    assert (int(made.n_excluded[0]), float(made.quality_share.sel(flag="glint")[0])) == (28 * 4, 0)
    assert made.attrs["flags"] == "those of the store, not said from what"
    # thresholds of the caller are not those of the store
    made = write_signatures(
        tmp_path / "lot.zarr", hp.Regions((HOOD,)), tmp_path / "b.zarr", flags={"shadow": 0.01}
    )
    assert len(surveys) == 1
    assert float(made.quality_share.sel(flag="shadow")[0]) == 0.0


def test_regions_are_proposed_with_the_same_survey(
    lot: Path, tmp_path: Path, surveys: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []

    def propose(line: xr.Dataset, model: Any = None, **options: Any) -> hp.Regions:
        given.append((model, options))
        window = hp.Region(
            "refused_01", [(0, 0), (4, 0), (4, 2), (0, 2)], properties={"refused": ["a window"]}
        )
        return Proposals((HOOD,), refused=hp.Regions((window,)))

    monkeypatch.setattr(field_day, "propose_regions", propose)
    told: list[tuple[int, int]] = []
    made = write_signatures(
        lot, None, tmp_path / "a.zarr", flags={"glint": 0.03}, progress=lambda *step: told.append(step)
    )
    assert len(surveys) == 1
    ((model, options),) = given
    assert isinstance(model, scene_model.SceneModel)
    assert options["glint"] == 0.03
    assert made.n_excluded[0] > 20
    assert made.attrs["refused"] == [f"{made.flightline.item()}, line 1, column 2: a window"]
    # half of the way for the survey, half for the pixels
    assert told == sorted(told)
    assert told[-1] == (2000, 2000)
    assert any(done <= 1000 for done, _ in told)
    write_signatures(lot, None, tmp_path / "b.zarr", flags=False, sun_zenith=30.0)
    assert given[-1][0] is None
    assert given[-1][1]["sun_zenith"] == 30.0


def test_smile_is_taken_out_before_flags() -> None:
    line = scene()
    shift = np.linspace(-3.0, 3.0, COLUMNS)
    bent = line.assign_coords(wavelength_shift=("cross_track", shift, {"units": "nm"}))
    done = flag_line(bent)
    assert "wavelength_shift" not in done.surveyed.variables
    np.testing.assert_array_equal(done.line.quality, hp.surroundings.flag(bent.paint.to_nominal()).quality)
    assert "wavelength_shift" in done.line.variables
    small = bent.assign_coords(wavelength_shift=("cross_track", 0.1 * shift, {"units": "nm"}))
    assert flag_line(small).surveyed is small


@pytest.mark.slow
def test_the_report_shows_what_is_found(
    lot: Path, tmp_path: Path, surveys: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    # the page is judged by its words; how figures are drawn is judged elsewhere
    monkeypatch.setattr(store_report, "png_of", lambda *_, **__: b"")
    before = {path: path.read_bytes() for path in lot.rglob("*") if path.is_file()}
    told: list[tuple[int, int]] = []
    done = hp.report.write_report(lot, tmp_path / "a.html", progress=lambda *step: told.append(step))
    assert done.problems == ()
    page = (tmp_path / "a.html").read_text()
    assert "were detected for this page" in page
    assert ">glint<" in page
    assert "Mirror image of the sun" in page  # the layer
    assert (len(surveys), told) == (1, sorted(told))
    assert len(told) > 2  # of the survey, too
    assert {path: path.read_bytes() for path in lot.rglob("*") if path.is_file()} == before
    plain = run("report", lot, "--out", tmp_path / "b.html", "--no-flags")
    assert plain.exit_code == 0, plain.output
    assert len(surveys) == 1
    assert ">glint<" not in (tmp_path / "b.html").read_text()
    nowhere = stored(scene(placed=False), tmp_path)
    words = {"could not be detected: the position of the sun": (), ">glint<": ("--sun-zenith", 30)}
    for number, (text, options) in enumerate(words.items()):
        done = run("report", nowhere, "--out", tmp_path / f"{number}.html", *options)
        assert done.exit_code == 0, done.output
        assert text in (tmp_path / f"{number}.html").read_text()
    done = run("site", nowhere, "--out", tmp_path / "site")
    assert (done.exit_code, "flags-not-searched" in done.output, "sun_zenith" in done.output) == (
        0,
        True,
        False,
    )


@pytest.mark.slow
def test_the_origin_of_flags_outlives_reflectance(tmp_path: Path) -> None:
    line = simulate_line(lines=32, bands=24, columns=16).assign_attrs(name="raw_0")
    flagged = line.paint.reflectance().paint.flag().compute()
    hp.to_store(flagged, tmp_path / "flagged.zarr", "flightlines/raw_0")
    again = hp.open_store(tmp_path / "flagged.zarr", "flightlines/raw_0").paint.reflectance()
    assert again.quality.attrs["flags_from"] == flagged.quality.attrs["flags_from"]
    np.testing.assert_array_equal(again.quality, flagged.quality)
    region = hp.Region("a", [(1, 2), (12, 2), (12, 20), (1, 20)], flightline="raw_0")
    made = field_day.write_signatures(
        tmp_path / "flagged.zarr", hp.Regions((region,)), tmp_path / "a.zarr", exclude=0
    )
    assert made.attrs["flags"] == "those of the store, " + flagged.quality.attrs["flags_from"]
