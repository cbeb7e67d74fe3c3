"""`process`: what lands in the store, when nothing is done, and what is refused."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr

import hyperpaint as hp
from hyperpaint.workflows.pipeline import run


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


def groups_of(store: Path) -> list[str]:
    from hyperpaint.io.store import list_groups

    return list_groups(store)


def lines_of(store: Path) -> Iterator[xr.Dataset]:
    for group in groups_of(store):
        if group.startswith("flightlines/"):
            yield xr.open_zarr(store, group=group)


def state_of(folder: Path) -> dict[str, tuple[int, int]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.stat().st_size)
        for path in sorted(folder.rglob("*"))
    }


def round_bits(values: np.ndarray[Any, Any], bits: int) -> np.ndarray[Any, Any]:
    # Round float32 to ``bits`` mantissa bits, to nearest-even, by integer arithmetic of its own
    raw = values.view(np.uint32).astype(np.uint64)
    drop = 23 - bits
    half = np.uint64((1 << (drop - 1)) - 1)
    even = (raw >> np.uint64(drop)) & np.uint64(1)
    rounded = ((raw + half + even) >> np.uint64(drop)) << np.uint64(drop)
    made = rounded.astype(np.uint32).view(np.float32)
    return np.where(np.isnan(values), values, made)


@pytest.mark.slow
def test_a_collect_becomes_one_group_a_line_and_the_archives(store: Path) -> None:
    lines = [name for name in groups_of(store) if name.startswith("flightlines/")]
    assert len(lines) == 2
    references = {"references/asd", "references/svc"}
    assert set(groups_of(store)) == {*lines, "calibration", "irradiance", *references}
    assert hp.verify(store).ok
    for line in lines_of(store):
        assert (
            line["counts"].dtype,
            line["reflectance"].dtype,
            line["quality"].dtype,
            line["irradiance_age"].dtype,
        ) == (np.uint16, np.float32, np.uint16, np.float32)
        assert (
            line["reflectance"].attrs["keep_bits"],
            line["counts"].data.chunksize[0],
            line.attrs["hyperpaint_format"],
        ) == (12, 32, 3)


def test_stored_reflectance_is_the_computed_one_rounded(store: Path) -> None:
    for line in lines_of(store):
        computed = line.paint.reflectance()
        expected = round_bits(computed["reflectance"].values, 12)
        np.testing.assert_array_equal(line["reflectance"].values, expected)
        np.testing.assert_array_equal(line["quality"].values, computed["quality"].values)
        np.testing.assert_array_equal(line["irradiance_age"].values, computed["irradiance_age"].values)
        ratio = line["reflectance"].values / computed["reflectance"].values
        assert np.nanmax(np.abs(ratio - 1)) <= 2.0**-13


def test_store_and_files_give_the_same_bits(source: Path, store: Path) -> None:
    tree = hp.open_collect(source / "collect.toml")
    for group in groups_of(store):
        if group.startswith("flightlines/"):
            opened = tree[group].to_dataset().paint.reflectance(keep_bits=12)
            stored = xr.open_zarr(store, group=group)
            for name in ("counts", "reflectance", "quality"):
                np.testing.assert_array_equal(opened[name].values, stored[name].values)
            np.testing.assert_array_equal(opened["time"].values, stored["time"].values)


def test_overview_is_the_picture_of_the_line(store: Path) -> None:
    line = next(lines_of(store))
    picture = line["overview"]
    assert (picture.dims, picture.dtype, picture.shape) == (
        ("overview_y", "overview_x", "rgb"),
        np.uint8,
        (line.sizes["along_track"], line.sizes["cross_track"], 3),
    )
    expected = hp.pictures.rgb(line[["reflectance"]]).values
    np.testing.assert_allclose(picture.values / 255.0, expected, atol=0.51 / 255)


@pytest.mark.slow
def test_lines_say_how_their_light_divides(store: Path) -> None:
    line = xr.open_zarr(store, group="flightlines/raw_0")
    assert line["sky_state"].attrs["flag_meanings"].split()[int(line["sky_state"][0])] == "clear"
    for name in ("diffuse_fraction", "diffuse_fraction_u"):
        assert (line[name].dims, line[name].dtype) == (("along_track", "band"), np.float32)
        assert bool(((line[name] > 0.0) & (line[name] < 1.0)).all())


def test_rerun_changes_nothing(collect: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.zarr"
    first = run(collect, out)
    before = state_of(tmp_path)
    second = run(collect, out)
    assert (set(second.unchanged), second.written, state_of(tmp_path)) == (set(first.written), (), before)


@pytest.mark.slow
def test_rerun_writes_only_what_is_missing(collect: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.zarr"
    text = collect.read_text()
    one = text[: text.rindex("[[flightlines]]")] + text[text.index("[[references]]") :]
    collect.write_text(one)
    run(collect, out)
    before = state_of(out / "flightlines" / "raw_0")
    collect.write_text(text)
    found = run(collect, out)
    assert len(found.written) == 1
    assert found.written[0].startswith("flightlines/")
    assert state_of(out / "flightlines" / "raw_0") == before
    assert hp.verify(out).ok


@pytest.mark.slow
def test_other_inputs_are_refused_without_overwrite(collect: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.zarr"
    hp.process(collect, out)
    before = state_of(out)
    collect.write_text(collect.read_text().replace("clock_offset_s = 37.25", "clock_offset_s = 38.25"))
    with pytest.raises(hp.StoreError, match="overwrite=True") as caught:
        hp.process(collect, out)
    for name in ("/flightlines/raw_0", "/irradiance"):
        assert name in str(caught.value)
    assert "/calibration" not in str(caught.value)
    assert state_of(out) == before
    found = run(collect, out, overwrite=True)
    assert found.unchanged == ("calibration", "references/asd", "references/svc")
    assert hp.verify(out).ok


@pytest.mark.slow
def test_a_changed_cube_is_other_input(collect: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.zarr"
    hp.process(collect, out)
    cube = collect.parent / "flight" / "raw_0"
    samples = np.fromfile(cube, "<u2")
    samples[0] += 1
    samples.tofile(cube)
    with pytest.raises(hp.StoreError, match=r"raw_0 .*store-exists"):
        hp.process(collect, out)


@pytest.mark.slow
def test_lines_of_another_collect_are_never_mixed_in(collect: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.zarr"
    hp.process(collect, out)
    collect.write_text(collect.read_text().replace('id = "raw_0"', 'id = "other"'))
    with pytest.raises(hp.StoreError, match=r"raw_0,.*group-foreign"):
        hp.process(collect, out, overwrite=True)


def test_a_folder_that_is_no_store_is_refused(collect: Path, tmp_path: Path) -> None:
    out = tmp_path / "photos"
    out.mkdir()
    (out / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(hp.StoreError):
        hp.process(collect, out, overwrite=True)
    assert [entry.name for entry in out.iterdir()] == ["holiday.jpg"]


def test_radiance_needs_no_irradiance(collect: Path, tmp_path: Path) -> None:
    text = collect.read_text()
    start, stop = text.index("[irradiance]"), text.index("[[flightlines]]")
    collect.write_text(text[:start] + text[stop:])
    with pytest.raises(hp.errors.CollectError, match="irradiance"):
        hp.process(collect, tmp_path / "lot.zarr")
    assert not (tmp_path / "lot.zarr").exists()
    out = hp.process(collect, tmp_path / "lot.zarr", to="radiance")
    for line in lines_of(out):
        assert "reflectance" not in line
        assert line["radiance"].dtype == np.float32
        np.testing.assert_array_equal(line["radiance"].values, line.paint.radiance()["radiance"].values)


@pytest.mark.slow
def test_reflectance_need_not_be_stored(collect: Path, store: Path, tmp_path: Path) -> None:
    out = hp.process(collect, tmp_path / "small.zarr", reflectance="none")
    for line, whole in zip(lines_of(out), lines_of(store), strict=True):
        assert "reflectance" not in line
        np.testing.assert_array_equal(line["quality"].values, whole["quality"].values)
        np.testing.assert_array_equal(line["overview"].values, whole["overview"].values)
        computed = line.paint.reflectance(keep_bits=12)["reflectance"].values
        np.testing.assert_array_equal(computed, whole["reflectance"].values)


def test_values_that_cannot_be_are_found_before_writing(
    collect: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_args: Any, **_kwargs: Any) -> None:
        msg = "the gain cannot be"
        raise hp.SchemaError(msg)

    monkeypatch.setattr("hyperpaint.radiometry.counts_to_reflectance.make_plan", refuse)
    with pytest.raises(hp.errors.CollectError, match="the gain cannot be") as caught:
        hp.process(collect, tmp_path / "lot.zarr")
    assert str(caught.value).count("the gain cannot be") == 2  # one for each line
    assert not (tmp_path / "lot.zarr").exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ["raw"]


def test_a_store_may_be_laid_out_for_looking(collect: Path, tmp_path: Path) -> None:
    out = hp.process(collect, tmp_path / "lot.zarr", layout="explore")
    group = next(name for name in hp.io.store.list_groups(out) if name.startswith("flightlines/"))
    line = xr.open_zarr(out, group=group)
    bands = line.sizes["band"]
    for name in ("counts", "reflectance"):
        assert line[name].data.chunksize[1] == -(-bands // 8) < bands
        assert hp.open_store(out, group)[name].data.numblocks[1] == 1
    assert hp.verify(out).ok
    stamp = (out / "zarr.json").stat().st_mtime_ns
    hp.process(collect, out)  # the same content, whatever its layout
    assert (out / "zarr.json").stat().st_mtime_ns == stamp
    with pytest.raises(hp.SchemaError, match=r"tiles.*choice-unknown"):
        hp.process(collect, out, layout="tiles")  # type: ignore[arg-type]


def test_words_are_checked(collect: Path, tmp_path: Path) -> None:
    words: Any = {"to": "albedo", "reflectance": "maybe"}
    with pytest.raises(hp.SchemaError, match=r"(?s)albedo.*maybe"):
        hp.process(collect, tmp_path / "lot.zarr", **words)


def test_progress_names_the_line_on_stderr(
    collect: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hp.process(collect, tmp_path / "lot.zarr", progress=True)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert re.match(r"flightlines/raw_0: flight line 1 of 2, \d+ scan lines\n", shown.err)
    assert "100% Completed" in shown.err


@pytest.mark.slow
def test_a_cluster_gives_the_same_bits(collect: Path, store: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0"
    ) as cluster:
        found = run(collect, tmp_path / "lot.zarr", scheduler=cluster.scheduler_address)
        again = run(collect, tmp_path / "lot.zarr")
    assert (len(found.written), again.written) == (6, ())
    for line, expected in zip(lines_of(found.path), lines_of(store), strict=True):
        for name in ("counts", "reflectance", "quality", "overview"):
            np.testing.assert_array_equal(line[name].values, expected[name].values)


def test_a_wrong_address_is_one_error(collect: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(hp.errors.CollectError, match="scheduler-unreachable"):
        hp.process(collect, tmp_path / "lot.zarr", scheduler="nonsense")
    assert dask.config.get("scheduler", None) is None  # later computations run where they ran before


def test_vendor_radiance_becomes_reflectance(collect: Path, store: Path, tmp_path: Path) -> None:
    line = hp.open_collect(collect)["flightlines/raw_0"].to_dataset()
    radiance = line.paint.radiance()["radiance"].values
    header = collect.parent / "flight" / "raw_0.hdr"
    text = header.read_text()
    assert "data type = 12" in text
    header.write_text(text.replace("data type = 12", "data type = 4"))
    (radiance * np.float32(100.0)).astype("<f4").tofile(collect.parent / "flight" / "raw_0")
    toml = collect.read_text().replace("[camera]", '[camera]\nradiance_units = "uW cm-2 sr-1 nm-1"')
    collect.write_text(toml[: toml.rindex("[[flightlines]]")])
    out = hp.process(collect, tmp_path / "lot.zarr")
    made = xr.open_zarr(out, group="flightlines/raw_0").load()
    expected = next(lines_of(store))["reflectance"].values
    assert made["radiance"].dtype == np.float32
    np.testing.assert_allclose(made["radiance"].values, radiance, rtol=1e-5)
    np.testing.assert_allclose(made["reflectance"].values, expected, rtol=2.0**-11)


def test_a_group_that_a_user_wrote_back_is_not_kept(source: Path, store: Path, tmp_path: Path) -> None:
    out = shutil.copytree(store, tmp_path / "lot.zarr")
    line = hp.io.store.open_store(out, "flightlines/raw_0").load()
    line["reflectance"] = line["reflectance"] * np.float32(2)
    hp.to_store(line, out, "flightlines/raw_0", overwrite=True)
    with pytest.raises(hp.StoreError, match=r"by process.*store-ex"):
        run(source / "collect.toml", out)
    assert run(source / "collect.toml", out, overwrite=True).written == ("flightlines/raw_0",)
    for made, expected in zip(lines_of(out), lines_of(store), strict=True):
        np.testing.assert_array_equal(made["reflectance"].values, expected["reflectance"].values)


def test_a_group_that_lacks_a_chunk_is_made_again(source: Path, store: Path, tmp_path: Path) -> None:
    out = shutil.copytree(store, tmp_path / "lot.zarr")
    group = [name for name in groups_of(out) if name.startswith("flightlines/")][-1]
    (out / group / "reflectance/c/1/0/0").unlink()
    assert run(source / "collect.toml", out).written == (group,)
    assert hp.verify(out).ok


def test_a_damaged_root_is_rebuilt_when_asked_for(source: Path, store: Path, tmp_path: Path) -> None:
    out = shutil.copytree(store, tmp_path / "lot.zarr")
    (out / "zarr.json").write_text("{")
    with pytest.raises(hp.StoreError, match="metadata-damaged"):
        run(source / "collect.toml", out)
    assert run(source / "collect.toml", out, overwrite=True).written == ()
    assert hp.verify(out).ok


def test_a_run_killed_at_its_first_metadata_is_run_again(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "lot.zarr"
    out.mkdir()
    (out / ".zarr.json.4711").write_text("{")
    assert len(run(source / "collect.toml", out, reflectance="none").written) == 6
    assert not (out / ".zarr.json.4711").exists()


@pytest.mark.parametrize("out", ["memory://lot.zarr", "s3://bucket/lot.zarr", Path("gs://bucket/lot.zarr")])
def test_a_url_is_refused(out: Any, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(hp.StoreError, match="output-is-url"):
        hp.process(source / "collect.toml", out)
    assert list(tmp_path.iterdir()) == []
