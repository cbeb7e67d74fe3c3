"""Bombs in the instruments' own formats, and in a ``collect.toml``."""

from __future__ import annotations

import gzip
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

__all__ = ["BOMBS"]

Bomb = Callable[[Path], Path]
BOMBS: list[tuple[Bomb, tuple[str, ...]]] = []

_MEGA = 10**6


def bomb(*doors: str) -> Callable[[Bomb], Bomb]:
    """Register a bomb for the doors that it is put through."""

    def register(made: Bomb) -> Bomb:
        BOMBS.append((made, doors))
        return made

    return register


# --- ENVI --------------------------------------------------------------------------------------------------


def _header(folder: Path, extra: str = "", data: bytes = bytes(800), **values: object) -> Path:
    fields: dict[str, object] = {"samples": 10, "lines": 10, "bands": 4, "header offset": 0}
    fields |= {"data type": 12, "interleave": "bil", "byte order": 0}
    fields |= {key.replace("_", " "): value for key, value in values.items()}
    text = "".join(f"{key} = {value}\n" for key, value in fields.items())
    (folder / "raw_0").write_bytes(data)
    path = folder / "raw_0.hdr"
    path.write_text(f"ENVI\n{text}{extra}", encoding="latin-1")
    return path


@bomb("envi", "info")
def envi_with_10_to_12_samples(folder: Path) -> Path:
    return _header(folder, samples=10**12)


@bomb("envi")
def envi_with_10_to_12_lines_and_1_sample(folder: Path) -> Path:
    return _header(folder, samples=1, lines=10**12, bands=1)


@bomb("envi")
def envi_product_overflows_to_the_right_size(folder: Path) -> Path:
    # 2**32 * 2**31 * 4 * 2 bytes are 0 modulo 2**64
    return _header(folder, samples=2**32, lines=2**31, bands=4, data=b"")


@bomb("envi")
def envi_product_overflows_to_800_bytes(folder: Path) -> Path:
    return _header(folder, samples=2**62 + 100, lines=4, bands=1)


@bomb("envi")
def envi_negative_sizes(folder: Path) -> Path:
    return _header(folder, samples=-10, lines=-10)


@bomb("envi")
def envi_zero_samples(folder: Path) -> Path:
    return _header(folder, samples=0)


@bomb("envi")
def envi_size_of_5000_digits(folder: Path) -> Path:
    return _header(folder, samples="9" * 5000)


@bomb("envi")
def envi_huge_header_offset(folder: Path) -> Path:
    return _header(folder, header_offset=2**63 - 1)


@bomb("envi")
def envi_negative_header_offset(folder: Path) -> Path:
    return _header(folder, header_offset=-800)


@bomb("envi")
def envi_brace_list_with_one_value_a_line(folder: Path) -> Path:
    return _header(folder, "wavelength = {\n" + "1,\n" * 1_390_000 + "1}\n")


@bomb("envi", "info")
def envi_300000_band_names(folder: Path) -> Path:
    return _header(folder, "band names = {" + "Band 1234567," * 300_000 + "x}\n")


@bomb("envi")
def envi_4_mb_of_wavelengths(folder: Path) -> Path:
    return _header(folder, "wavelength = {" + "450.0," * 690_000 + "1}\n")


@bomb("envi")
def envi_280000_keys(folder: Path) -> Path:
    return _header(folder, "".join(f"key{number} = 1\n" for number in range(280_000)))


@bomb("envi")
def envi_brace_never_closed(folder: Path) -> Path:
    return _header(folder, "description = {" + "{" * _MEGA)


@bomb("envi")
def envi_header_of_100_mb(folder: Path) -> Path:
    return _header(folder, "; " + "x" * 100 * _MEGA)


@bomb("envi")
def envi_header_is_gzip(folder: Path) -> Path:
    path = _header(folder)
    path.write_bytes(gzip.compress(path.read_bytes()))
    return path


@bomb("envi")
def envi_wavelengths_beyond_float(folder: Path) -> Path:
    return _header(folder, "wavelength = {1e999, nan, inf, -1e308}\n")


@bomb("envi")
def envi_data_is_a_sparse_terabyte(folder: Path) -> Path:
    path = _header(folder)
    os.truncate(folder / "raw_0", 10**12)
    return path


@bomb("envi")
def envi_path_in_the_header(folder: Path) -> Path:
    (folder.parent / "bait" / "cube").write_bytes(bytes(800))
    return _header(folder, "data file = ../bait/cube\n", data=b"")


# --- spectra -----------------------------------------------------------------------------------------------


def _asd_file(folder: Path, changes: dict[int, bytes], tail: bytes = b"", cut: int | None = None) -> Path:
    """Write an ASD file that would be right but for ``changes``: offset to bytes."""
    from hyperpaint.simulation import simulate_collect

    simulate_collect(folder / "made", scene="plan", lines=4, bands=4, columns=4)
    data = bytearray(sorted((folder / "made/asd").glob("*.asd"))[0].read_bytes())
    for place, new in changes.items():
        data[place : place + len(new)] = new
    path = folder / "sky.asd"
    path.write_bytes(bytes(data[:cut]) + tail)
    return path


@bomb("asd", "info")
def asd_with_65535_channels(folder: Path) -> Path:
    return _asd_file(folder, {204: struct.pack("<H", 65535)})


@bomb("asd")
def asd_with_no_channels(folder: Path) -> Path:
    return _asd_file(folder, {204: struct.pack("<H", 0)})


@bomb("asd")
def asd_with_forged_blocks(folder: Path) -> Path:
    return _asd_file(folder, {}, tail=b"\x01" + struct.pack("<H", 65535) * 50_000)


@bomb("asd")
def asd_of_100_mb(folder: Path) -> Path:
    return _asd_file(folder, {}, tail=bytes(100 * _MEGA))


@bomb("asd")
def asd_ends_within_its_header(folder: Path) -> Path:
    return _asd_file(folder, {}, cut=300)


@bomb("asd")
def asd_with_endless_wavelengths(folder: Path) -> Path:
    return _asd_file(folder, {191: struct.pack("<ff", 1e38, 1e38)})


@bomb("asd")
def asd_text_with_ten_million_columns(folder: Path) -> Path:
    path = folder / "sky.txt"
    path.write_text("Wavelength" + "\ta" * 10 * _MEGA + "\n350" + "\t1" * 10 * _MEGA + "\n")
    return path


@bomb("asd")
def asd_text_is_a_zip(folder: Path) -> Path:
    path = folder / "sky.txt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("sky.txt", bytes(50 * _MEGA))
    return path


@bomb("irradiance", "info")
def csv_of_one_line_of_100_mb(folder: Path) -> Path:
    path = folder / "sky.csv"
    path.write_bytes(b"time,400,410\n" + b"1," * 50 * _MEGA)
    return path


@bomb("irradiance")
def csv_with_a_header_of_100_mb(folder: Path) -> Path:
    path = folder / "sky.csv"
    path.write_bytes(b"time" + b",400" * 25 * _MEGA)
    return path


@bomb("irradiance")
def csv_is_gzip(folder: Path) -> Path:
    path = folder / "sky.csv"
    path.write_bytes(gzip.compress(b"time,400,410\n" + bytes(50 * _MEGA)))
    return path


@bomb("irradiance")
def csv_numbers_of_a_megabyte(folder: Path) -> Path:
    path = folder / "sky.csv"
    path.write_text("time,400,410\n" + "2024-05-21T12:00:00Z," + "9" * _MEGA + "e" + "9" * _MEGA + ",1\n")
    return path


@bomb("irradiance")
def csv_quote_never_closed(folder: Path) -> Path:
    path = folder / "sky.csv"
    path.write_text('time,400,410\n"' + "2024-05-21T12:00:00Z,1,1\n" * 5_000)
    return path


# --- side files --------------------------------------------------------------------------------------------


@bomb("frame-index", "info")
def frame_number_of_10_to_18(folder: Path) -> Path:
    path = folder / "frameIndex_0.txt"
    path.write_text(f"Frame#\tTimestamp\n0\t1000000\n{10**18}\t2000000\n")
    return path


@bomb("frame-index")
def frame_number_beyond_int64(folder: Path) -> Path:
    path = folder / "frameIndex_0.txt"
    path.write_text(f"Frame#\tTimestamp\n{2**64}\t1\n{'9' * 100_000}\t2\n")
    return path


@bomb("frame-index")
def frame_index_with_a_million_columns(folder: Path) -> Path:
    path = folder / "frameIndex_0.txt"
    path.write_text("Frame#\tTimestamp" + "\tx" * _MEGA + "\n" + "1\t" * _MEGA + "\n")
    return path


@bomb("imu-gps")
def navigation_with_a_million_columns(folder: Path) -> Path:
    path = folder / "imu_gps.txt"
    names = "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time"
    path.write_text(names + "\tx" * _MEGA + "\n" + "1\t" * _MEGA + "\n")
    return path


@bomb("imu-gps", "info")
def navigation_of_numbers_beyond_float(folder: Path) -> Path:
    path = folder / "imu_gps.txt"
    names = "Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\tGps_UTC_Date&Time\n"
    rows = "".join(
        f"1e999\tnan\t{'9' * 9999}\t1e999\t1\t1\t{'9' * 99}\t2021/07/20 12:00:00.{i}\n" for i in range(9)
    )
    path.write_text(names + rows)
    return path


@bomb("settings", "info")
def settings_of_one_line_of_100_mb(folder: Path) -> Path:
    path = folder / "settings.txt"
    path.write_bytes(b"Exposure (ms) = " + b"5" * 100 * _MEGA)
    return path


@bomb("settings")
def settings_exposure_of_15_mb(folder: Path) -> Path:
    path = folder / "settings.txt"
    path.write_bytes(b"Exposure (ms) = " + b"5" * 15 * _MEGA)
    return path


@bomb("settings")
def settings_of_brackets(folder: Path) -> Path:
    path = folder / "settings.txt"
    path.write_bytes(b"Exposure (" * 1_500_000 + b"ms) = 5 x\nExposure (ms) = 4\n")
    return path


@bomb("settings", "frame-index", "imu-gps", "asd", "irradiance", "info")
def pipe_in_place_of_a_file(folder: Path) -> Path:
    path = folder / "settings.txt"
    os.mkfifo(path)
    return path


@bomb("settings", "frame-index", "imu-gps", "asd", "irradiance", "info")
def endless_device_in_place_of_a_file(folder: Path) -> Path:
    path = folder / "settings.txt"
    path.symlink_to("/dev/zero")
    return path


# --- collect.toml ------------------------------------------------------------------------------------------


def _toml(folder: Path, text: str) -> Path:
    path = folder / "collect.toml"
    path.write_text(text)
    return path


def _irradiance_files(folder: Path, pattern: str) -> Path:
    line = '[[flightlines]]\nid = "a"\ncube = "raw_0"\nstart_time = 2024-05-21T12:00:00Z\n'
    line += "frame_period_ms = 7.0\n"
    return _toml(folder, f'[irradiance]\nfiles = "{pattern}"\nquantity = "irradiance"\n{line}')


@bomb("collect", "info")
def toml_of_nested_lists(folder: Path) -> Path:
    return _toml(folder, "x = " + "[" * 500_000)


@bomb("collect")
def toml_of_nested_tables(folder: Path) -> Path:
    return _toml(folder, "x = " + "{a = " * 100_000)


@bomb("collect")
def toml_key_of_100000_parts(folder: Path) -> Path:
    return _toml(folder, ".".join("a" * 100_000) + " = 1\n")


@bomb("collect")
def toml_table_of_100000_parts(folder: Path) -> Path:
    return _toml(folder, "[" + " . ".join("a" * 100_000) + "]\n")


@bomb("collect")
def toml_with_half_a_million_files(folder: Path) -> Path:
    return _toml(folder, "[irradiance]\nfiles = [" + '"",' * 300_000 + "]\n")


@bomb("collect")
def toml_of_10_mb(folder: Path) -> Path:
    return _toml(folder, "# " + "x" * 10 * _MEGA)


@bomb("collect")
def toml_numbers_of_a_megabyte(folder: Path) -> Path:
    return _toml(folder, "[camera]\nbit_depth = 0x" + "f" * _MEGA)


@bomb("collect")
def toml_with_20000_flight_lines_of_one_name(folder: Path) -> Path:
    return _toml(folder, '[[flightlines]]\nid="a"\ncube="b"\n' * 20_000)


@bomb("collect")
def toml_is_a_pipe(folder: Path) -> Path:
    path = folder / "collect.toml"
    os.mkfifo(path)
    return path


@bomb("collect")
def toml_is_an_endless_device(folder: Path) -> Path:
    path = folder / "collect.toml"
    path.symlink_to("/dev/zero")
    return path


@bomb("collect")
def toml_pattern_over_the_whole_disk(folder: Path) -> Path:
    return _irradiance_files(folder, "/**/*.asd")


@bomb("collect")
def toml_pattern_around_in_links(folder: Path) -> Path:
    for name in "ab":
        (folder / name).symlink_to(".")
    return _irradiance_files(folder, "**/*.asd")


@bomb("collect")
def toml_pattern_of_stars_around_in_links(folder: Path) -> Path:
    for name in "abc":
        (folder / name).symlink_to(".")
    return _irradiance_files(folder, "*/" * 36 + "*.asd")


@bomb("collect")
def toml_pattern_that_takes_fnmatch_long(folder: Path) -> Path:
    (folder / ("a" * 200)).touch()
    return _irradiance_files(folder, "*a" * 100 + "b")


@bomb("collect")
def toml_with_many_double_stars(folder: Path) -> Path:
    deep = folder
    for _ in range(30):
        deep = deep / "d"
        deep.mkdir()
    return _irradiance_files(folder, "**/" * 30 + "*.asd")


@bomb("collect")
def toml_names_a_pipe(folder: Path) -> Path:
    os.mkfifo(folder / "sky.asd")
    return _irradiance_files(folder, "sky.asd")


@bomb("collect")
def toml_names_an_endless_device(folder: Path) -> Path:
    return _irradiance_files(folder, "/dev/zero")


@bomb("collect")
def toml_names_a_link_to_a_device(folder: Path) -> Path:
    (folder / "sky.asd").symlink_to("/dev/zero")
    return _irradiance_files(folder, "sky.asd")


@bomb("collect")
def toml_flight_line_id_leads_out(folder: Path) -> Path:
    return _toml(folder, '[[flightlines]]\nid = "../../bait"\ncube = "raw_0"\n')
