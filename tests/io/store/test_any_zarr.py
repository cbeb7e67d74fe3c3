"""Any Zarr that xarray opens is a store, calibration, sweep, record, library and set of references."""

import itertools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import xarray as xr
import zarr
from support.refusals import expect_error

import hyperpaint as hp
from hyperpaint.base.errors import IncompleteStoreError, StoreError
from hyperpaint.io.flightline.side_files import open_calibration, open_sweep
from hyperpaint.io.spectrometers.reference_files import open_references
from hyperpaint.io.store import list_groups

pytestmark = pytest.mark.filterwarnings(
    "ignore:Consolidated metadata", "ignore:The data type:zarr.errors.UnstableSpecificationWarning"
)

NM = {"units": "nm"}


def cube() -> xr.Dataset:
    rng = np.random.default_rng(1)
    return xr.Dataset(
        {
            "counts": (
                ("along_track", "band", "cross_track"),
                rng.integers(0, 4000, (70, 3, 8)).astype("u2"),
            ),
            "note": ("band", np.array(["rot", "grün", ""], object)),
        },
        {"time": ("along_track", np.datetime64("2024-05-21", "ns") + np.arange(70) * 7_000_000)},
    )


def calibration() -> xr.Dataset:
    gain = np.linspace(1e-10, 2e-10, 12, dtype=np.float32).reshape(3, 4)
    return xr.Dataset(
        {"radiance_gain": (("band", "cross_track"), gain, {"units": "W m-2 sr-1 nm-1 s count-1"})},
        {"wavelength": ("band", [500.0, 550.0, 600.0], NM), "fwhm": ("band", [6.0] * 3, NM)},
        {"srf_shape": "slit"},
    )


def sweep() -> xr.Dataset:
    counts = np.random.default_rng(2).integers(0, 4000, (6, 3, 4)).astype("u2")
    return xr.Dataset({"counts": (("step", "band", "cross_track"), counts)})


def record() -> xr.Dataset:
    stamps = np.datetime64("2024-05-21T12:00:00", "ns") + np.arange(8) * np.timedelta64(1, "s")
    values = np.random.default_rng(3).random((8, 60), dtype="f4") + 1
    return xr.Dataset(
        {"irradiance": (("irradiance_time", "irradiance_wavelength"), values, {"units": "W m-2 nm-1"})},
        {
            "irradiance_time": stamps,
            "irradiance_wavelength": ("irradiance_wavelength", np.arange(400.0, 1000, 10), NM),
        },
    )


def library() -> xr.Dataset:
    values = np.random.default_rng(4).random((2, 5), dtype="f4")
    return xr.Dataset(
        {"reflectance": (("signature", "band"), values, {"units": "1"})},
        {
            "signature": np.array(["rot", "blau"], object),
            "wavelength": ("band", np.linspace(400.0, 800.0, 5), NM),
            "fwhm": ("band", [5.0] * 5, NM),
        },
    )


def navigation() -> xr.Dataset:
    rng = np.random.default_rng(5)
    time = np.datetime64("2026-06-01T12:00", "ns") + np.arange(40) * np.timedelta64(1, "s")
    names = ("latitude", "longitude", "altitude", "roll", "pitch", "heading")
    values = {
        name: ("navigation_time", rng.random(40), {"units": "m" if name == "altitude" else "degree"})
        for name in names
    }
    return xr.Dataset(values, {"navigation_time": time}, {"convention_column_order": "left_to_right"})


def _only(opened: list[xr.Dataset]) -> xr.Dataset:
    (dataset,) = opened
    return dataset


USES: dict[str, tuple[Callable[[], xr.Dataset], Callable[[Any], xr.Dataset]]] = {
    "store": (cube, hp.open_store),
    "calibration": (calibration, open_calibration),
    "sweep": (sweep, open_sweep),
    "record": (record, lambda store: hp.open_irradiance(store, fwhm_nm=3.0, max_gap_s=5.0)),
    "library": (library, hp.open_library),
    "navigation": (navigation, hp.open_navigation),
    "references": (library, lambda store: _only(open_references([store]))),
}


def encodings(dataset: xr.Dataset, zarr_format: int, codec: str) -> dict[Any, dict[str, Any]]:
    # Return the encoding of a codec for the numbers of a dataset; ``default`` leaves it to xarray
    import numcodecs
    from zarr.codecs import BloscCodec, GzipCodec, ZstdCodec

    second = {"zstd": numcodecs.Zstd(), "gzip": numcodecs.GZip(), "blosc": numcodecs.Blosc()}
    third = {"zstd": ZstdCodec(), "gzip": GzipCodec(), "blosc": BloscCodec()}
    numbers = [name for name, variable in dataset.variables.items() if variable.dtype.kind in "uf"]
    if codec == "default":
        return {}
    if codec == "shards":
        return {
            name: {"shards": dataset[name].shape, "chunks": (1, *dataset[name].shape[1:])}
            for name in [name for name in numbers if dataset[name].ndim > 1]
        }
    compressor = (second if zarr_format == 2 else third)[codec]
    return {name: {"compressors": [compressor]} for name in numbers}


def contained(dataset: xr.Dataset, container: str, folder: Path, **options: Any) -> Any:
    # Write a dataset by plain xarray into a container; return what a user would open
    path = folder / "plain.zarr"
    plain = dataset.drop_encoding()
    if container == "icechunk":
        icechunk = pytest.importorskip("icechunk")
        session = icechunk.Repository.create(icechunk.in_memory_storage()).writable_session("main")
        plain.to_zarr(session.store, consolidated=False, **options)
        return session.store
    if container == "object":
        store = zarr.storage.MemoryStore()
        plain.to_zarr(store, consolidated=False, **options)
        return store
    if container.startswith("url"):
        url = f"memory://{folder.name}.zarr"
        plain.to_zarr(url, consolidated=container == "url, consolidated", **options)
        return url
    plain.to_zarr(path, consolidated=container != "folder, not consolidated", **options)
    if container == "zip":
        return shutil.make_archive(str(folder / "plain"), "zip", path)
    return path


CONTAINERS = (
    "folder", "folder, not consolidated", "zip", "url", "url, consolidated", "object", "icechunk",
)  # fmt: skip
#: Every codec in a folder, every container in one codec of each format.
TABLE = [
    *((fmt, codec, "folder") for fmt in (2, 3) for codec in ("default", "zstd", "gzip", "blosc")),
    (3, "shards", "folder"),
    *((fmt, "zstd", container) for fmt, container in itertools.product((2, 3), CONTAINERS[1:])),
    (3, "shards", "zip"),
]
TABLE.remove((2, "zstd", "icechunk"))  # which holds format 3 alone
#: Of what is not a store only the containers: zarr alone decodes.
CASES = [
    (use, *row) for use, row in itertools.product(USES, TABLE)
    if use == "store" or row[1:] not in itertools.product(("zstd", "gzip", "blosc"), ["folder"])
]  # fmt: skip


@pytest.fixture(scope="module")
def use(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, ...]:
    # What makes a dataset, what reads it, and what it reads from a store of our own
    make, read = USES[request.param]
    return make, read, read(hp.to_store(make(), tmp_path_factory.mktemp("ours") / "ours.zarr")).load()


@pytest.mark.parametrize(("use", "zarr_format", "codec", "container"), CASES, indirect=["use"])
def test_it_gives_the_same_bits_as_our_own(
    use: tuple[Any, ...], zarr_format: int, codec: str, container: str, tmp_path: Path
) -> None:
    make, read, ours = use
    place = contained(
        make(), container, tmp_path, zarr_format=zarr_format, encoding=encodings(make(), zarr_format, codec)
    )
    theirs = read(place).load()
    xr.testing.assert_equal(theirs, ours)
    assert set(theirs.variables) == set(ours.variables)
    for name, variable in ours.variables.items():
        assert theirs[name].dtype.kind in variable.dtype.kind + "OT"
        if variable.dtype.kind in "ufM":
            assert theirs[name].values.tobytes() == variable.values.tobytes()


@pytest.mark.filterwarnings("ignore::hyperpaint.base.errors.PaintWarning")
@pytest.mark.parametrize(("zarr_format", "container"), [(2, "folder"), (2, "zip"), (3, "zip")])
def test_a_collect_names_any_zarr(zarr_format: int, container: str, tmp_path: Path) -> None:
    collect = hp.simulate_collect(tmp_path / "day", scene="plan", lines=8, bands=4, columns=4)
    expected = hp.open_collect(collect)["calibration"].radiance_gain
    source = xr.open_zarr(collect.parent / "calibration.zarr").load()
    place = contained(source, container, tmp_path, zarr_format=zarr_format)
    text = collect.read_text().replace('"calibration.zarr"', f'"{Path(place).as_posix()}"')
    assert Path(place).name in text
    collect.write_text(text)
    assert hp.open_collect(collect)["calibration"].radiance_gain.values.tobytes() == expected.values.tobytes()


@pytest.mark.parametrize("zarr_format", [2, 3])
@pytest.mark.parametrize("container", ["folder", "zip", "url"])
def test_groups_are_listed_opened_and_verified(zarr_format: int, container: str, tmp_path: Path) -> None:
    place = contained(xr.Dataset(), "folder", tmp_path, zarr_format=zarr_format)
    plain = {"zarr_format": zarr_format, "consolidated": False}
    for group in ("flightlines/a", "flightlines/b"):
        cube().to_zarr(place, group=group, **plain)
    if container == "zip":
        place = Path(shutil.make_archive(str(tmp_path / "plain"), "zip", place))
    if container == "url":
        fsspec.filesystem("memory").put(str(place), f"/{tmp_path.name}.zarr", recursive=True)
        place = f"memory://{tmp_path.name}.zarr"
    assert list_groups(place) == ["flightlines/a", "flightlines/b"]
    xr.testing.assert_equal(hp.open_store(place)["flightlines/a"].to_dataset(), cube())
    report = hp.verify(place)
    assert report.ok, str(report)
    assert report.chunks >= 6
    assert "not written by hyperpaint" in report.notes[0]
    expect_error(StoreError, "group-unknown", lambda: hp.open_store(place, "c"))


def test_our_own_in_a_zip_file_is_verified(tmp_path: Path) -> None:
    path = hp.to_store(cube(), tmp_path / "lot.zarr", "flightlines/a")
    packed = shutil.make_archive(str(tmp_path / "lot"), "zip", path)
    report = hp.verify(packed)
    assert (report.ok, report.notes) == (True, ())
    xr.testing.assert_equal(hp.open_store(packed, "flightlines/a"), cube())
    (path / "flightlines/a/counts/c/1/0/0").unlink()
    packed = shutil.make_archive(str(tmp_path / "other"), "zip", path)
    assert "counts/c/1/0/0: the chunk is missing" in str(hp.verify(packed))
    expect_error(IncompleteStoreError, "chunk-missing", lambda: hp.open_store(packed, "flightlines/a"))
