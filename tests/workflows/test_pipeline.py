"""`process`: what lands in the store, when nothing is done, and what is refused."""

import os
import re
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import dask
import distributed
import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_error, expect_errors, expect_words
from support.tiny_collects import tiny_collect, without_references

import hyperpaint as hp
from hyperpaint.base.constants import NUMERICS_VERSION
from hyperpaint.base.errors import CollectError, PaintWarning, SchemaError
from hyperpaint.io.files import reading
from hyperpaint.io.files.reading import sampled_digest
from hyperpaint.io.store import list_groups
from hyperpaint.simulation import simulate_collect
from hyperpaint.workflows.maps import lines_of_store
from hyperpaint.workflows.pipeline import compare_inputs, finishing_command, paths_in, run


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Folder of a small simulated collect: two cubes, dropped frames
    folder = tmp_path_factory.mktemp("collect")
    hp.simulate_collect(folder, scene="plan", lines=72, bands=20, columns=12, cubes=2, dropped=3, seed=3)
    return folder


@pytest.fixture(scope="module")
def store(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    # The processed collect; tests only read it
    return hp.process(source / "collect.toml", tmp_path_factory.mktemp("store") / "lot.zarr")


@pytest.fixture
def collect(source: Path, tmp_path: Path) -> Path:
    # A copy of the collect that a test may spoil; its ``collect.toml``
    shutil.copytree(source, tmp_path / "raw", copy_function=shutil.copy2)
    return tmp_path / "raw" / "collect.toml"


def lines_of(store: Path) -> Iterator[xr.Dataset]:
    return (xr.open_zarr(store, group=f"flightlines/{name}") for name in lines_of_store(store))


def state_of(folder: Path) -> dict[str, tuple[int, int]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.stat().st_size)
        for path in sorted(folder.rglob("*"))
    }


def assert_same(line: xr.Dataset, expected: xr.Dataset, *names: str) -> None:
    for name in names:
        np.testing.assert_array_equal(line[name].values, expected[name].values, err_msg=name)


def round_bits(values: np.ndarray[Any, Any], bits: int) -> np.ndarray[Any, Any]:
    # Round float32 to ``bits`` mantissa bits, to nearest-even, by integer arithmetic of its own
    raw, drop = values.view(np.uint32).astype(np.uint64), np.uint64(23 - bits)
    rounded = ((raw + np.uint64((1 << (22 - bits)) - 1) + ((raw >> drop) & np.uint64(1))) >> drop) << drop
    return np.where(np.isnan(values), values, rounded.astype(np.uint32).view(np.float32))


@pytest.mark.slow
def test_a_collect_becomes_one_group_a_line_and_the_archives(source: Path, store: Path) -> None:
    names = lines_of_store(store)
    assert len(names) == 2
    lines = {f"flightlines/{name}" for name in names}
    assert set(list_groups(store)) == lines | {
        "calibration",
        "irradiance",
        "references/asd",
        "references/svc",
    }
    assert hp.verify(store).ok
    tree = hp.open_collect(source / "collect.toml")["flightlines"]
    dtypes = {"counts": "u2", "reflectance": "f4", "quality": "u2", "irradiance_age": "f4", "overview": "u1"}
    for name, line in zip(names, lines_of(store), strict=True):
        assert {name: line[name].dtype for name in dtypes} == dtypes
        attrs = line["reflectance"].attrs["keep_bits"], line.attrs["hyperpaint_format"]
        assert (line["counts"].data.chunksize[0], *attrs) == (32, 12, 3)
        # what is stored is what the store computes, rounded
        computed = line.paint.reflectance()
        assert_same(line, computed, "quality", "irradiance_age")
        values = computed["reflectance"].values
        np.testing.assert_array_equal(line["reflectance"].values, round_bits(values, 12))
        assert np.nanmax(np.abs(line["reflectance"].values / values - 1)) <= 2.0**-13
        # the files give the same bits
        opened = tree[name].to_dataset().paint.reflectance(keep_bits=12)
        assert_same(line, opened, "counts", "reflectance", "quality", "time")
        # the overview is the picture of the line
        assert line["overview"].dims == ("overview_y", "overview_x", "rgb")
        assert line["overview"].shape == (line.sizes["along_track"], line.sizes["cross_track"], 3)
        np.testing.assert_allclose(
            line["overview"].values / 255.0, hp.pictures.rgb(line[["reflectance"]]).values, atol=0.51 / 255
        )
    # how its light divides
    assert line["sky_state"].attrs["flag_meanings"].split()[int(line["sky_state"][0])] == "clear"
    for part in (line["diffuse_fraction"], line["diffuse_fraction_u"]):
        assert (part.dims, part.dtype) == (("along_track", "band"), np.float32)
        assert bool(((part > 0.0) & (part < 1.0)).all())


@pytest.mark.slow
def test_rerun_keeps_what_is_current_and_refuses_other_inputs(
    collect: Path, store: Path, tmp_path: Path
) -> None:
    out, text = shutil.copytree(store, tmp_path / "lot.zarr"), collect.read_text()
    before, again = state_of(tmp_path), run(collect, out)
    assert (set(again.unchanged), again.written, state_of(tmp_path)) == (set(list_groups(store)), (), before)
    # lines of another collect are never mixed in
    collect.write_text(text.replace('id = "raw_0"', 'id = "other"'))
    expect_error(hp.StoreError, r"raw_0,.*group-foreign", lambda: hp.process(collect, out, overwrite=True))
    before = state_of(out)
    collect.write_text(text.replace("clock_offset_s = 37.25", "clock_offset_s = 38.25"))
    error = str(expect_error(hp.StoreError, "overwrite=True", lambda: hp.process(collect, out)))
    expect_words(error, "/flightlines/raw_0", "/irradiance", without=("/calibration",))
    assert state_of(out) == before
    assert run(collect, out, overwrite=True).unchanged == ("calibration", "references/asd", "references/svc")
    assert hp.verify(out).ok
    # a changed cube is other input
    samples = np.fromfile(collect.parent / "flight" / "raw_0", "<u2")
    samples[0] += 1
    samples.tofile(collect.parent / "flight" / "raw_0")
    expect_error(hp.StoreError, r"raw_0 .*store-exists", lambda: hp.process(collect, out))


def test_radiance_needs_no_irradiance(collect: Path, tmp_path: Path) -> None:
    text = collect.read_text()
    collect.write_text(text[: text.index("[irradiance]")] + text[text.index("[[flightlines]]") :])
    expect_error(hp.errors.CollectError, "irradiance", lambda: hp.process(collect, tmp_path / "lot.zarr"))
    assert not (tmp_path / "lot.zarr").exists()
    for line in lines_of(hp.process(collect, tmp_path / "lot.zarr", to="radiance")):
        assert "reflectance" not in line
        assert line["radiance"].dtype == np.float32
        assert_same(line, line.paint.radiance(), "radiance")


@pytest.mark.slow
def test_reflectance_need_not_be_stored(collect: Path, store: Path, tmp_path: Path) -> None:
    # where a run was killed at its first metadata
    out = tmp_path / "small.zarr"
    out.mkdir()
    (out / ".zarr.json.4711").write_text("{")
    assert len(run(collect, out, reflectance="none").written) == 6
    assert not (out / ".zarr.json.4711").exists()
    for line, whole in zip(lines_of(out), lines_of(store), strict=True):
        assert "reflectance" not in line
        assert_same(line, whole, "quality", "overview")
        assert_same(line.paint.reflectance(keep_bits=12), whole, "reflectance")


def test_values_that_cannot_be_are_found_before_writing(
    collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_args: Any, **_kwargs: Any) -> None:
        raise hp.SchemaError("the gain cannot be")

    monkeypatch.setattr("hyperpaint.radiometry.counts_to_reflectance.make_plan", refuse)
    error = expect_error(
        hp.errors.CollectError, "the gain cannot be", lambda: hp.process(collect, tmp_path / "lot.zarr")
    )
    assert str(error).count("the gain cannot be") == 2  # one for each line
    assert [entry.name for entry in tmp_path.iterdir()] == ["raw"]


def test_a_store_may_be_laid_out_for_looking(
    collect: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = hp.process(without_references(collect), tmp_path / "lot.zarr", layout="explore", progress=True)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert re.match(r"flightlines/raw_0: flight line 1 of 2, \d+ scan lines\n", shown.err)
    assert "100% Completed" in shown.err
    line, group = next(lines_of(out)), f"flightlines/{lines_of_store(out)[0]}"
    for name in ("counts", "reflectance"):
        assert line[name].data.chunksize[1] == -(-line.sizes["band"] // 8) < line.sizes["band"]
        assert hp.open_store(out, group)[name].data.numblocks[1] == 1
    assert hp.verify(out).ok
    stamp = (out / "zarr.json").stat().st_mtime_ns
    hp.process(collect, out)  # the same content, whatever its layout
    assert (out / "zarr.json").stat().st_mtime_ns == stamp


def test_what_is_refused(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").write_bytes(b"x")
    process: Any = partial(hp.process, source / "collect.toml")
    expect_errors(
        (hp.SchemaError, r"tiles.*choice-unknown", lambda: process("lot.zarr", layout="tiles")),
        (hp.SchemaError, r"(?s)albedo.*maybe", lambda: process("lot.zarr", to="albedo", reflectance="maybe")),
        (CollectError, "scheduler-unreachable", lambda: process("lot.zarr", scheduler="nonsense")),
        (hp.StoreError, "photos", lambda: process("photos", overwrite=True)),
    )
    assert dask.config.get("scheduler", None) is None  # later computations run where they ran before
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")] == ["photos/holiday.jpg"]


@pytest.mark.slow
def test_a_cluster_gives_the_same_bits(collect: Path, store: Path, tmp_path: Path) -> None:
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": ":0"}
    without_references(collect)
    with distributed.LocalCluster(**options) as cluster:
        found = run(collect, tmp_path / "lot.zarr", scheduler=cluster.scheduler_address)
        again = run(collect, tmp_path / "lot.zarr")
    assert (len(found.written), again.written) == (4, ())
    for line, expected in zip(lines_of(found.path), lines_of(store), strict=True):
        assert_same(line, expected, "counts", "reflectance", "quality", "overview")


def test_vendor_radiance_becomes_reflectance(collect: Path, store: Path, tmp_path: Path) -> None:
    radiance = hp.open_collect(collect)["flightlines/raw_0"].to_dataset().paint.radiance()["radiance"].values
    header = collect.parent / "flight" / "raw_0.hdr"
    assert "data type = 12" in header.read_text()
    header.write_text(header.read_text().replace("data type = 12", "data type = 4"))
    (radiance * np.float32(100.0)).astype("<f4").tofile(header.with_suffix(""))
    toml = collect.read_text().replace("[camera]", '[camera]\nradiance_units = "uW cm-2 sr-1 nm-1"')
    collect.write_text(toml[: toml.rindex("[[flightlines]]")])
    made = next(lines_of(hp.process(collect, tmp_path / "lot.zarr"))).load()
    expected = next(lines_of(store))["reflectance"].values
    assert made["radiance"].dtype == np.float32
    np.testing.assert_allclose(made["radiance"].values, radiance, rtol=1e-5)
    np.testing.assert_allclose(made["reflectance"].values, expected, rtol=2.0**-11)


def test_damaged_groups_and_roots_are_made_again(source: Path, store: Path, tmp_path: Path) -> None:
    out, toml = shutil.copytree(store, tmp_path / "lot.zarr"), source / "collect.toml"
    # a group that a user wrote back is not kept
    line = hp.open_store(out, "flightlines/raw_0").load()
    line["reflectance"] = line["reflectance"] * np.float32(2)
    hp.to_store(line, out, "flightlines/raw_0", overwrite=True)
    expect_error(hp.StoreError, r"by process.*store-ex", lambda: run(toml, out))
    assert run(toml, out, overwrite=True).written == ("flightlines/raw_0",)
    for made, expected in zip(lines_of(out), lines_of(store), strict=True):
        assert_same(made, expected, "reflectance")
    group = f"flightlines/{lines_of_store(out)[-1]}"
    (out / group / "reflectance/c/1/0/0").unlink()
    assert run(toml, out).written == (group,)
    (out / "zarr.json").write_text("{")
    expect_error(hp.StoreError, "metadata-damaged", lambda: run(toml, out))
    assert run(toml, out, overwrite=True).written == ()
    assert hp.verify(out).ok


# --- `process` again: unchanged groups stay, inputs are compared ---

LINES = ("flightlines/raw_0", "flightlines/raw_1")


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    return tiny_collect(tmp_path / "raw", 2)


def test_rerun_writes_only_what_is_missing(tiny: Path, tmp_path: Path) -> None:
    out, text = tmp_path / "lot.zarr", tiny.read_text()
    tiny.write_text(text[: text.rindex("[[flightlines]]")])
    assert process(tiny, out).written == (LINES[0],)
    before = state_of(out / LINES[0])
    tiny.write_text(text)
    assert process(tiny, out).written == (LINES[1],)
    assert state_of(out / LINES[0]) == before
    assert hp.verify(out).ok


@pytest.fixture
def radiance_store(tiny: Path, tmp_path: Path) -> Path:
    return process(tiny, tmp_path / "lot.zarr").path


def process(collect: Path, out: Path, **options: Any) -> Any:
    return run(collect, out, to="radiance", **options)


def test_content_alone_tells_other_inputs(tiny: Path, radiance_store: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny.parent, tmp_path / "copy", copy_function=shutil.copyfile)
    for file in tiny.parent.iterdir():
        os.utime(file, (1e9, 1e9))
    for collect in (tiny, tmp_path / "copy" / "collect.toml"):
        assert process(collect, radiance_store).written == ()
    # another header makes other values of the same file
    header, cube = tiny.with_name("raw_1.hdr"), tiny.with_name("raw_1")
    text = header.read_text()
    for old, new in (("interleave = bil", "interleave = bip"), ("byte order = 0", "byte order = 1")):
        assert old in text
        header.write_text(text.replace(old, new))
        expect_error(hp.StoreError, r"raw_1 .*store-exists", lambda: process(tiny, radiance_store))
    header.write_text(text)
    # whatever its times are
    status, values = cube.stat(), np.fromfile(cube, "<f4")
    values[7] += 1
    values.tofile(cube)
    os.utime(cube, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert "raw_0" not in str(
        expect_error(hp.StoreError, r"raw_1 .*store-exists", lambda: process(tiny, radiance_store))
    )
    assert process(tiny, radiance_store, overwrite=True).written == (LINES[1],)


def test_the_command_that_finishes_a_run_names_its_options() -> None:
    options = {
        "--to": "radiance",
        "--accept": ["dark-of-zeros", "a b"],
        "--overwrite": True,
        "--alignment": None,
    }
    command = finishing_command("process lot.toml", options)
    assert command == (
        "hyperpaint process lot.toml --out {store} --to radiance --accept dark-of-zeros --accept 'a b' "
        "--overwrite"
    )


def test_large_files_are_told_apart_by_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "SAMPLES", 4)
    monkeypatch.setattr(reading, "SAMPLE_BYTES", 16)
    content = np.random.default_rng(1).bytes(1000)
    (tmp_path / "cube").write_bytes(content)
    digest = sampled_digest(tmp_path / "cube")
    for place in (0, 330, 660, 999):
        changed = bytearray(content)
        changed[place] ^= 1
        (tmp_path / "cube").write_bytes(changed)
        assert sampled_digest(tmp_path / "cube") != digest
    for other in (content[:-1], content + b"\0", bytes(1000)):
        (tmp_path / "cube").write_bytes(other)
        assert sampled_digest(tmp_path / "cube") != digest


def test_other_numerics_are_said_and_computed_on_request(
    tiny: Path, radiance_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    current = NUMERICS_VERSION
    for module in ("workflows.pipeline", "io.store.manifest"):
        monkeypatch.setattr(f"hyperpaint.{module}.NUMERICS_VERSION", 7)
    report = hp.verify(radiance_store)
    assert report.ok
    assert report.notes == (f"made by numerics {current}, this is 7: --overwrite computes it again",)
    expect_error(
        hp.StoreError,
        rf"version {current} of the numerics;.*store-ex",
        lambda: process(tiny, radiance_store),
    )
    assert (
        process(tiny, radiance_store, overwrite=True).written,
        hp.verify(radiance_store).notes,
    ) == (LINES, ())


def test_other_settings_cut_short_are_not_whole(
    tiny: Path, radiance_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hyperpaint.io.store.writer import WholeRun

    write = WholeRun.write

    def stop(self: WholeRun, group: str, dataset: xr.Dataset, **options: Any) -> None:
        if group == LINES[1]:
            raise KeyboardInterrupt
        write(self, group, dataset, **options)

    tiny.write_text(tiny.read_text().replace("frame_period_ms = 7.0", "frame_period_ms = 8.0"))
    with monkeypatch.context() as patch:
        patch.setattr(WholeRun, "write", stop)
        expect_error(KeyboardInterrupt, None, lambda: process(tiny, radiance_store, overwrite=True))
    report = hp.verify(radiance_store)
    assert "unfinished: 1 of 2 groups are written, without /flightlines/raw_1" in str(report)
    assert report.resume == f"hyperpaint process {tiny} --out {radiance_store} --to radiance --overwrite"
    assert process(tiny, radiance_store, overwrite=True).written == (LINES[1],)
    assert hp.verify(radiance_store).ok


@pytest.mark.parametrize("overwrite", [True, False])
def test_inputs_are_never_written_over(
    tiny: Path, radiance_store: Path, overwrite: bool, tmp_path: Path
) -> None:
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for out in (tiny.parent, tmp_path, tiny.parent / ".." / "raw"):
        caught = expect_error(
            hp.StoreError, "output-is-input", partial(process, tiny, out, overwrite=overwrite)
        )
        assert "whether or not it may overwrite" in str(caught)
    inside = tiny_collect(radiance_store / "raw", 1)
    expect_error(
        hp.StoreError,
        r"raw_0.*output-is-input",
        lambda: process(inside, radiance_store, overwrite=overwrite),
    )
    shutil.rmtree(radiance_store / "raw")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_folder_with_a_calibration_is_no_damaged_store(tmp_path: Path) -> None:
    field = tmp_path / "field"
    hp.to_store(xr.Dataset({"radiance_gain": ("band", [1.0])}), field / "calibration.zarr")
    before = sorted(field.rglob("*"))
    for name in (None, "flightlines/raw_0"):
        expect_error(
            hp.StoreError,
            "store-foreign",
            partial(hp.to_store, xr.Dataset({"a": ("x", [1.0])}), field, name, overwrite=True),
        )
    assert sorted(field.rglob("*")) == before


def test_paths_are_found_in_whatever_names_them(tmp_path: Path) -> None:
    one, two, three = (tmp_path / name for name in "abc")
    assert set(
        paths_in({"cubes": [one, (two, "no path")], "more": {"deep": {three}}, "type": Path, "none": None})
    ) == {one, two, three}


def test_inputs_are_compared_whole(
    tiny: Path, radiance_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = compare_inputs(radiance_store)
    assert (report.collect, report.blocks, report.problems) == (tiny, 2, ())
    assert "all unchanged" in str(report)
    # what no sample shows
    monkeypatch.setattr("hyperpaint.workflows.pipeline.sampled_digest", lambda _: "same")
    run(tiny, radiance_store, to="radiance", overwrite=True)
    assert compare_inputs(radiance_store).problems == ()
    cube = tiny.with_name("raw_1")
    values = np.fromfile(cube, "<f4")
    values[7] += 1
    values.tofile(cube)
    assert compare_inputs(radiance_store).problems == (
        f"/{LINES[1]}: radiance, lines 0 to 5: differs from the stored samples",
    )
    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), radiance_store, "signatures")
    os.rename(tiny.parent, tmp_path / "elsewhere")
    expect_error(hp.StoreError, "file-not-found", lambda: compare_inputs(radiance_store))
    moved = tmp_path / "elsewhere/collect.toml"
    moved.write_text(moved.read_text().replace("7.0", "8.0", 1))
    assert [text[:19] for text in compare_inputs(radiance_store, moved).problems] == [
        "/flightlines/raw_0:",
        "/flightlines/raw_1:",
    ]
    hp.to_store(xr.Dataset({"a": ("x", [1.0])}), tmp_path / "other.zarr", "a")
    expect_error(hp.StoreError, "inputs-unrecorded", lambda: compare_inputs(tmp_path / "other.zarr"))


# --- camera and irradiance record are compared before a line is processed ---


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A collect whose record is 4 nm wide, where its collect.toml says 3
    folder = tmp_path_factory.mktemp("collect")
    path = simulate_collect(
        folder, lines=24, columns=32, scene="plan", seed=71, irradiance_fwhm_nm=4.0, noise=False
    )
    path.write_text(path.read_text().replace("fwhm_nm = 4.0", "fwhm_nm = 3.0"))
    return without_references(path)


def copy_of(collect: Path, folder: Path, table: str) -> Path:
    shutil.copytree(collect.parent, folder)
    path = folder / collect.name
    path.write_text(path.read_text() + table)
    return path


def oxygen_error(line: xr.Dataset, collect: Path) -> float:
    truth = xr.open_zarr(collect.parent / "truth.zarr").reflectance.values
    measured, near = line.reflectance.values.astype(float), abs(line.wavelength.values - 760.5) < 6
    true_mean = np.nanmean(np.where(np.isnan(measured), np.nan, truth), axis=(0, 2))
    return float(abs(np.nanmean(measured, axis=(0, 2)) / true_mean - 1)[near].max())


def test_a_wrong_width_is_corrected_by_default(wide: Path, tmp_path: Path) -> None:
    store = tmp_path / "lot.zarr"
    done = hyperpaint("process", wide, "--out", store, "--quiet", status=0)
    assert "/flightlines/raw_0: irradiance record corrected in flight" in done.output
    # the default, spelled out, has nothing to write
    stamp = (store / "zarr.json").stat().st_mtime_ns
    hyperpaint("process", wide, "--out", store, "--alignment", "auto", "--quiet", status=0)
    assert (store / "zarr.json").stat().st_mtime_ns == stamp
    line = hp.open_store(store, LINES[0])
    assert line.attrs["alignment_state"] == "applied"
    assert line.attrs["alignment_width"] == pytest.approx(4 / 3, abs=0.02)
    assert "irradiance record corrected in flight" in line.attrs["alignment"]
    assert oxygen_error(line, wide) < 0.003
    # the store computes again what it holds
    np.testing.assert_array_equal(
        hp.reflectance(line.drop_vars("reflectance"), keep_bits=12).reflectance, line.reflectance
    )
    assert hp.open_store(store, "irradiance").irradiance_fwhm.values == pytest.approx(3.0)


def test_never_is_a_warning_and_the_collect_may_say_so(wide: Path, tmp_path: Path) -> None:
    path = copy_of(wide, tmp_path / "raw", '\n[alignment]\napply = "never"\n')
    with pytest.warns(PaintWarning, match="irradiance record differ"):
        hp.process(path, tmp_path / "lot.zarr")
    line = hp.open_store(tmp_path / "lot.zarr", LINES[0])
    assert line.attrs["alignment_state"] == "not applied"
    assert oxygen_error(line, wide) > 0.02
    words: Any = {"alignment": "yes"}
    path = copy_of(wide, tmp_path / "wrong", '\n[alignment]\napply = "yes"\n')
    expect_errors(
        (SchemaError, "choice-unknown", lambda: hp.process(wide, tmp_path / "x.zarr", **words)),
        (CollectError, "alignment", lambda: hp.process(path, tmp_path / "x.zarr")),
    )
