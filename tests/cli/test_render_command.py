"""From a ``scene.toml`` to a store: what is in it, that it is whole, and what is refused."""

import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import dask
import distributed
import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.files import write_file
from support.refusals import expect_error, expect_errors, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import FormatError, SchemaError, StoreError
from hyperpaint.io.store import list_groups
from hyperpaint.simulation.camera import Camera
from hyperpaint.simulation.settings import SimulationSettings
from hyperpaint.workflows import rendering

pytestmark = pytest.mark.slow  # the tracer is compiled


SCENE = """\
[scene]
name = "tiny park"
kind = "car_park"
length_m = 10
width_m = 16
margin_m = 5
leaves = 50
seed = 2
[platform]
lines = 40
columns = 24
ground_sample_m = 0.4
wobble_deg = 0.2
[camera]
bands = 12
fwhm_nm = 30
smile_nm = 1.5
bad_elements = 2
[sampling]
samples = 4
[[atmospheres]]
preset = "noon"
[[atmospheres]]
preset = "cloudy"
[output]
product = "counts"
"""


def scene_file(folder: Path, text: str = SCENE) -> Path:
    return write_file(folder / "scene.toml", text, encoding="utf-8")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A rendered store
    folder = tmp_path_factory.mktemp("render")
    return hp.render_scene(scene_file(folder), folder / "scene.zarr")


def opened(store: Path, group: str) -> xr.Dataset:
    return xr.open_zarr(store, group=group).load()


def assert_same(one: xr.Dataset, other: xr.Dataset) -> None:
    xr.testing.assert_identical(one.drop_attrs(), other.drop_attrs())


# --- what is in it -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_store_is_whole_and_says_what_it_is(store: Path) -> None:
    assert hp.verify(store).ok
    assert list_groups(store) == ["renders/cloudy", "renders/noon", "transport"]
    root = xr.open_zarr(store)
    assert (root.attrs["name"], root.attrs["scene_file"]) == ("tiny park", SCENE)


def test_a_render_is_a_flight_line(store: Path) -> None:
    line = xr.open_zarr(store, group="renders/noon")
    assert line.counts.dtype == np.uint16
    assert dict(line.sizes) | {"along_track": 40, "band": 12, "cross_track": 24} == dict(line.sizes)
    found = line.paint.reflectance().compute()
    seen = found.reflectance.notnull()
    assert (seen.sum() > 0.97 * seen.size).item()
    # two elements see no light
    assert int((~seen).all("along_track").sum()) == 2
    error = (found.reflectance - line.true_reflectance).where(found.quality == 0).compute()
    # what is left is noise, the haze of 15 m of air, and rounding
    assert abs(float(error.median())) < 1e-3
    assert float(np.abs(error).quantile(0.9)) < 0.02
    for name in ("roll", "pitch", "heading", "altitude", "time"):
        assert name in line.coords, name
    assert (np.diff(line.irradiance_time) == np.timedelta64(2, "s")).all()
    assert line.irradiance_time[0] < line.time[0]
    assert line.time[-1] < line.irradiance_time[-1]


def test_labels_say_what_their_numbers_mean(store: Path) -> None:
    line = opened(store, "renders/noon")
    kinds = line.surface_class.attrs["flag_meanings"].split()
    assert len(kinds) == len(line.surface_class.attrs["flag_values"])
    assert {"asphalt", "paint", "glass"} <= {kinds[number] for number in np.unique(line.surface_class)}
    instances = json.loads(line.attrs["instances"])
    cars = np.unique(line.car_id)
    assert ((cars[0], len(cars) > 3), {instances[number]["kind"] for number in cars[1:]}) == (
        (-1, True),
        {"car"},
    )
    on_paint = line.surface_class.values == kinds.index("paint")
    paints = line.paint_id.attrs["flag_meanings"].split()
    for number in cars[1:]:
        here = on_paint & (line.car_id.values == number)
        names = {paints[paint] for paint in np.unique(line.paint_id.values[here])}
        assert names <= {instances[number]["paint"]}, names
    assert ((line.purity > 0) & (line.purity <= 1)).all()
    total = line.sun_share + line.sky_share
    np.testing.assert_allclose(total.values[np.isfinite(total.values)], 1.0, atol=1e-5)


def test_renders_come_from_the_stored_rays(store: Path) -> None:
    traced = xr.open_zarr(store, group="transport")
    camera = Camera.of(SimulationSettings(
        lines=40, columns=24, bands=12, fwhm_nm=30.0, smile_nm=1.5, bad_elements=2,
    ))  # fmt: skip
    relit = traced.paint.relight(camera.imager, atmosphere="cloudy").compute()
    line = opened(store, "renders/cloudy")
    np.testing.assert_allclose(line.true_reflectance, relit.reflectance, rtol=2.0**-13)
    assert line.true_reflectance.dtype == np.float32
    assert (line.true_reflectance.values.view(np.uint32) & 0x7FF == 0).all()
    expected = np.asarray(relit.radiance) * line.exposure_time.item() / line.radiance_gain.values
    noise = line.counts.values - line.dark_counts.values - expected
    good = np.isfinite(noise) & (line.counts.values < 4095)
    spread = np.sqrt(np.maximum(expected, 0) / 20.0 + 0.25 + 1 / 12)
    assert np.std((noise / spread)[good]) == pytest.approx(1.0, abs=0.05)


def test_radiance_has_no_noise_and_no_counts(tmp_path: Path) -> None:
    path = hp.render_scene(scene_file(tmp_path), tmp_path / "out.zarr", to="radiance", atmospheres=["noon"])
    line = xr.open_zarr(path, group="renders/noon")
    assert "counts" not in line
    assert line.radiance.attrs["units"] == "W m-2 sr-1 nm-1"
    found = line.paint.reflectance().reflectance
    np.testing.assert_allclose(found, line.true_reflectance, rtol=0.02, atol=2e-3)


def test_paints_and_spectra_of_the_file_are_used(tmp_path: Path) -> None:
    (tmp_path / "mine.csv").write_text("300,0.25\n1200,0.25\n")
    text = """[scene]
kind = "plane"
[platform]
lines = 3
columns = 2
[camera]
bands = 5
[spectra]
mine = "mine.csv"
[paints]
ground = "mine"
[sampling]
samples = 256
"""
    path = hp.render_scene(scene_file(tmp_path, text), tmp_path / "out.zarr")
    # the sky is brighter towards the sun: what is left is the noise of its samples
    np.testing.assert_allclose(opened(path, "renders/noon").true_reflectance, 0.25, rtol=2e-3)


def test_without_noise_counts_are_rounded_light(tmp_path: Path) -> None:
    text = SCENE.replace("bad_elements = 2", "noise = false").replace("lines = 40", "lines = 4")
    # over bands of 30 nm the detector weighs the steep light of 400 nm otherwise than its response does
    text = text.replace("fwhm_nm = 30", "fwhm_nm = 6")
    path = hp.render_scene(scene_file(tmp_path, text), tmp_path / "out.zarr", atmospheres=["noon"])
    found = xr.open_zarr(path, group="renders/noon").paint.reflectance()
    assert float(np.abs((found.reflectance - found.true_reflectance).where(found.quality == 0)).max()) < 0.005


# --- the same whatever computes it -------------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [7, 40])
def test_counts_do_not_depend_on_chunks(chunk: int) -> None:
    camera = Camera.of(SimulationSettings(lines=40, columns=3, bands=4, fwhm_nm=30.0))
    values = np.random.default_rng(0).uniform(0.0, 0.2, (40, 4, 3)).astype(np.float32)

    def counts(lines: int) -> xr.Dataset:
        cube = xr.DataArray(values, dims=("along_track", "band", "cross_track")).chunk(along_track=lines)
        return rendering.counts_of(cube, camera, 5e-3, 7, "noon")

    made, reference = counts(chunk), counts(1)
    assert made.counts.dtype == made.counts.compute().dtype == np.uint16
    with dask.config.set(scheduler="synchronous"):
        expected = reference.compute()
    xr.testing.assert_identical(made.compute(), expected)
    other = rendering.counts_of(reference.counts.astype("f4"), camera, 5e-3, 8, "noon")
    assert not np.array_equal(other.dark_counts, reference.dark_counts)


@pytest.mark.slow
def test_renders_do_not_depend_on_the_scheduler(store: Path, tmp_path: Path) -> None:
    with dask.config.set(scheduler="synchronous"):
        alone = hp.render_scene(scene_file(tmp_path), tmp_path / "alone.zarr", atmospheres=["noon"])
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None
        ) as cluster,
    ):
        spread = hp.render_scene(
            tmp_path / "scene.toml", tmp_path / "spread.zarr", scheduler=cluster.scheduler_address,
            atmospheres=["noon"],
        )  # fmt: skip
    for group in ("transport", "renders/noon"):
        reference = opened(store, group)
        assert_same(opened(alone, group), reference)
        assert_same(opened(spread, group), reference)


# --- again, otherwise, interrupted -------------------------------------------------------------------------


@pytest.mark.slow
def test_a_finished_store_is_left_alone(tmp_path: Path) -> None:
    file, out = scene_file(tmp_path), tmp_path / "out.zarr"
    first = hyperpaint("render", file, "--out", out, "--atmosphere", "noon", "--samples", 2, status=0)
    assert first.stdout == f"{out}: wrote /transport, /renders/noon\n"
    before = {path: path.stat().st_mtime_ns for path in (out / "transport").rglob("*")}
    again = hyperpaint("render", file, "--out", out, "--atmosphere", "noon", "--samples", 2)
    assert again.stdout == f"{out} is already complete: same inputs, same parameters; nothing was done\n"
    # another light of the same file costs no tracing
    more = hyperpaint("render", file, "--out", out, "--samples", 2)
    expect_words(more.stdout, "wrote /renders/cloudy", "/renders/noon, /transport there already")
    assert {path: path.stat().st_mtime_ns for path in (out / "transport").rglob("*")} == before
    other = hyperpaint("render", file, "--out", out, "--samples", 3, status=2)
    assert "/transport exists, from other inputs or parameters; pass --overwrite" in other.stderr
    orphan = hyperpaint(
        "render", file, "--out", out, "--samples", 3, "--atmosphere", "noon", "--overwrite", status=2
    )
    assert "holds /renders/cloudy, of a scene traced with other parameters" in orphan.stderr
    assert hyperpaint("render", file, "--out", out, "--samples", 3, "--overwrite").exit_code == 0
    assert hp.verify(out).ok
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.zarr", "scene.toml"]


_KILLED = """
import os, sys
import dask, hyperpaint
from hyperpaint.simulation.rendering import relighting

original, traced = relighting.trace_rays, []

def trace_or_die(*arguments):
    traced.append(arguments)
    if len(traced) == 4:
        os._exit(9)
    return original(*arguments)

relighting.trace_rays = trace_or_die
with dask.config.set(scheduler="synchronous"):
    hyperpaint.render_scene(*sys.argv[1:], atmospheres=["noon"])
"""


@pytest.mark.slow
def test_a_killed_run_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hyperpaint.simulation.rendering import relighting

    text = SCENE.replace("lines = 40", "lines = 160").replace("samples = 4", "samples = 1")
    file, out = scene_file(tmp_path, text.replace("columns = 24", "columns = 4")), tmp_path / "out.zarr"
    done = subprocess.run([sys.executable, "-c", _KILLED, str(file), str(out)], timeout=120, check=False)
    assert done.returncode == 9
    assert "unfinished: 0 of 2 groups are written" in str(hp.verify(out))
    traced: list[int] = []
    original = relighting.trace_rays

    def note(prepared: Any, origin: Any, rotation: Any, edges: Any, first_line: int) -> Any:
        traced.append(first_line)
        return original(prepared, origin, rotation, edges, first_line)

    monkeypatch.setattr(relighting, "trace_rays", note)
    with dask.config.set(scheduler="synchronous"):
        hp.render_scene(file, out, atmospheres=["noon"])
        # blocks that were stored are not traced again
        assert 2 <= len(traced) < 5
        whole = hp.render_scene(file, tmp_path / "whole.zarr", atmospheres=["noon"])
    for group in ("transport", "renders/noon"):
        assert_same(opened(out, group), opened(whole, group))
    assert sorted(each.name for each in tmp_path.iterdir()) == ["out.zarr", "scene.toml", "whole.zarr"]


# --- what is refused ---------------------------------------------------------------------------------------


def test_calls_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "out.zarr"
    render: Any = partial(hp.render_scene, scene_file(tmp_path))
    unknown = "no atmosphere 'dusk' in the scene file, expected some of noon, cloudy"
    expect_errors(
        (SchemaError, "samples=0", lambda: render(out, samples=0)),
        (SchemaError, "samples=1000000000000", lambda: render(out, samples=10**12)),
        (SchemaError, "to='reflectance'", lambda: render(out, to="reflectance")),
        (SchemaError, unknown, lambda: render(out, atmospheres=["dusk"])),
    )
    # spectra that no paint has
    file = scene_file(tmp_path, SCENE + '[spectra]\nmine = "mine.csv"\n[paints]\nasphalt = "mine"\n')
    for spectrum, problem in (
        ("300,0.2\n1200,1.3\n", "value-out-of-range"),
        ("500,0.2\n600,0.3\n", "spectrum-coverage"),
        ("300,0.2\n1200,nan\n", "not-finite"),
    ):
        (tmp_path / "mine.csv").write_text(spectrum)
        expect_error((SchemaError, FormatError), problem, partial(hp.render_scene, file, out))
    # a scene larger than the disk is refused before anything is built
    text = SCENE.replace("lines = 40", "lines = 1_000_000").replace("columns = 24", "columns = 20_000")
    text = text.replace("ground_sample_m = 0.4", "ground_sample_m = 0.001")
    file = scene_file(tmp_path, text.replace("bands = 12", "bands = 4"))
    expect_error(StoreError, r"633\.30 GiB.*disk-full", lambda: hp.render_scene(file, out))
    assert not out.exists()


def test_problems_are_one_message_and_status_2(tmp_path: Path) -> None:
    file = scene_file(tmp_path, SCENE.replace("samples = 4", "samples = 0").replace("[camera]", "[kamera]"))
    result = hyperpaint("render", file, "--out", tmp_path / "out.zarr", status=2)
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    expect_words(result.stderr, "unknown table or key 'kamera'; did you mean 'camera'?", "samples = 0")
    assert hyperpaint("render", tmp_path / "none.toml", "--out", tmp_path / "out.zarr").exit_code == 2


def test_a_render_of_nothing_is_warned_of(tmp_path: Path) -> None:
    text = '[scene]\nkind = "plane"\nsize_m = 5\n[platform]\nlines = 2\ncolumns = 2\ncentre_m = [90, 0]\n'
    result = hyperpaint("render", scene_file(tmp_path, text + "[sampling]\nsamples = 1\n"), status=0)
    assert "ground-not-seen" in result.output


# --- the command -------------------------------------------------------------------------------------------


def test_the_example_is_printed_and_help_teaches() -> None:
    from hyperpaint.workflows.rendering import example_scene

    assert hyperpaint("render", "--example").stdout == example_scene()
    assert "hyperpaint render --example > scene.toml" in hyperpaint("render", "--help").stdout
    assert " render  " in hyperpaint("--help").stdout


def test_pictures_are_drawn(store: Path, tmp_path: Path) -> None:
    picture = tmp_path / "renders.png"
    hyperpaint("render", store.parent / "scene.toml", "--out", store, "--picture", picture, status=0)
    assert picture.read_bytes().startswith(b"\x89PNG")
    # before anything is traced
    result = hyperpaint(
        "render", store.parent / "scene.toml", "--out", tmp_path / "a.zarr", "--picture", "a.xyz", status=2
    )
    assert "suffix-unknown" in result.output
    assert not (tmp_path / "a.zarr").exists()
