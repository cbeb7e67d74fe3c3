"""Bombs in the chunks of Zarr stores: forged frames, and what unpacks to more than it says."""

from __future__ import annotations

import gzip
import os
import shutil
import zlib
from pathlib import Path

import numpy as np

from .bomb_making import (
    BOMBS,
    GZIP,
    MEGA,
    NAME,
    READ,
    ZSTD,
    blosc,
    bomb,
    framed,
    sealed_store,
    sizes,
)

__all__ = ["BOMBS"]


def _compressed(size: int = 96) -> bytearray:
    from numcodecs import Blosc

    return bytearray(Blosc("lz4", shuffle=Blosc.BITSHUFFLE).encode(np.zeros(size // 4, "f4")))


@bomb(*READ)
def blosc_frame_of_2_gib(folder: Path) -> Path:
    frame = _compressed()
    frame[4:8] = (2**31 - 17).to_bytes(4, "little")
    return framed(folder, bytes(frame), blosc())


@bomb(*READ)
def blosc_frame_that_ends_beyond_the_chunk(folder: Path) -> Path:
    frame = _compressed()
    frame[12:16] = (2**30).to_bytes(4, "little")
    return framed(folder, bytes(frame), blosc())


@bomb(*READ)
def blosc_frame_of_blocks_larger_than_itself(folder: Path) -> Path:
    frame = _compressed()
    frame[8:12] = (2**31 - 1).to_bytes(4, "little")
    return framed(folder, bytes(frame), blosc())


@bomb(*READ)
def blosc_frame_of_a_true_gigabyte(folder: Path) -> Path:
    return framed(folder, bytes(_compressed(2**28)), blosc(), **sizes(4, 250_000))


@bomb(*READ)
def blosc_frame_of_15_bytes(folder: Path) -> Path:
    return framed(folder, bytes(_compressed()[:15]), blosc())


def _zstd_frame(size: int, blocks: int) -> bytes:
    """Return a zstd frame that says ``size``, of as many blocks that repeat a zero 128 KiB long."""
    head = b"\x28\xb5\x2f\xfd\xe0" + size.to_bytes(8, "little")
    run = (2**17 << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    last = (2**17 << 3 | 1 << 1 | 1).to_bytes(3, "little") + b"\0"
    return head + run * (blocks - 1) + last


@bomb(*READ)
def zstd_bomb_of_10_gb(folder: Path) -> Path:
    return framed(folder, _zstd_frame(80_000 * 2**17, 80_000), ZSTD, **sizes(4, 30_000))


@bomb(*READ)
def zstd_frame_that_says_a_tebibyte(folder: Path) -> Path:
    return framed(folder, _zstd_frame(2**40, 1), ZSTD)


@bomb(*READ)
def zstd_frame_that_says_nothing(folder: Path) -> Path:
    frame = _zstd_frame(0, 8000)
    return framed(folder, frame[:4] + b"\x00\x58" + frame[13:], ZSTD, **sizes(4, 30_000))


@bomb(*READ)
def zstd_frame_that_holds_more_than_it_says(folder: Path) -> Path:
    return framed(folder, _zstd_frame(96, 900), ZSTD)


@bomb(*READ)
def zstd_second_frame_after_an_honest_one(folder: Path) -> Path:
    from numcodecs import Zstd

    return framed(folder, bytes(Zstd().encode(bytes(96))) + _zstd_frame(8000 * 2**17, 1000), ZSTD)


@bomb(*READ)
def gzip_bomb(folder: Path) -> Path:
    piece = zlib.compressobj(9, wbits=31)
    data = b"".join(piece.compress(bytes(MEGA)) for _ in range(200)) + piece.flush()
    return framed(folder, data[:4000], GZIP)


@bomb(*READ)
def gzip_bomb_in_a_large_chunk(folder: Path) -> Path:
    piece = zlib.compressobj(9, wbits=31)
    data = b"".join(piece.compress(bytes(MEGA)) for _ in range(400)) + piece.flush()
    return framed(folder, data, GZIP, **sizes(4, 3 * MEGA))


@bomb(*READ)
def gzip_of_many_members(folder: Path) -> Path:
    return framed(folder, gzip.compress(b"") * 200, GZIP)


@bomb(*READ)
def chunk_of_100_mb_for_96_bytes(folder: Path) -> Path:
    store = sealed_store(folder)
    os.truncate(store / NAME / "c/0/0", 100 * MEGA)
    return store


@bomb(*READ)
def text_of_four_billion_items(folder: Path) -> Path:
    return framed(folder, (2**32 - 1).to_bytes(4, "little"), name="note")


@bomb(*READ)
def text_that_ends_beyond_the_chunk(folder: Path) -> Path:
    return framed(folder, (1).to_bytes(4, "little") + (2**31).to_bytes(4, "little") + b"text", name="note")


@bomb(*READ)
def text_in_a_forged_frame(folder: Path) -> Path:
    frame = _compressed()
    frame[4:8] = (2**31 - 17).to_bytes(4, "little")
    return framed(folder, bytes(frame), blosc(typesize=1), name="note")


@bomb(*READ)
def chunk_is_a_link_out(folder: Path) -> Path:
    store = sealed_store(folder)
    bait = folder.parent / "bait/chunk"
    shutil.move(store / NAME / "c/0/0", bait)
    (store / NAME / "c/0/0").symlink_to(bait)
    return store


@bomb(*READ)
def chunk_folder_is_a_link_out(folder: Path) -> Path:
    store = sealed_store(folder)
    shutil.move(store / NAME / "c", folder.parent / "bait/c")
    (store / NAME / "c").symlink_to(folder.parent / "bait/c")
    return store


@bomb(*READ)
def chunk_is_a_pipe(folder: Path) -> Path:
    store = sealed_store(folder)
    (store / NAME / "c/0/0").unlink()
    os.mkfifo(store / NAME / "c/0/0")
    return store


@bomb("verify")
def link_to_the_whole_disk_among_chunks(folder: Path) -> Path:
    store = sealed_store(folder)
    (store / NAME / "c/more").symlink_to("/")
    return store
