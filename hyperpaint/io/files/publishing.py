"""Files and folders that appear whole or not at all.

They are built in the folder that a store is built in, ``.partial-<name>`` beside their place: see
`hyperpaint.io.store.stage`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from hyperpaint.base.errors import PaintError, Problems, StoreError
from hyperpaint.io.store.disk import flush_group
from hyperpaint.io.store.location import sync
from hyperpaint.io.store.stage import Staging, discard, staging

__all__ = ["check_place", "publish_file", "published_files", "published_folder"]

_MEND = "pass {}, or choose another path"


def check_place(
    path: Path, product: str, *, example: str, kinds: Sequence[str] = (), store: Path | None = None,
    overwrite: bool = False, error: type[PaintError] = StoreError,
) -> None:  # fmt: skip
    """Refuse a place for a file before anything is read or drawn; all reasons are listed.

    Messages name the ``product``, such as "the table", and an ``example`` of a name. ``kinds`` are the
    suffixes that it may have, any by default; it may not be in ``store``.
    """
    problems = Problems(f"{product} cannot be written to {path}", error)
    if kinds and path.suffix.lower() not in kinds:
        several = "one of " + ", ".join(kinds) if len(kinds) > 2 else " or ".join(kinds)
        problems.add(f"expected a name that ends in {several}")
    if store is not None and store.resolve() in (path.resolve(), *path.resolve().parents):
        problems.add("that is in the store itself; choose another path")
    elif path.is_dir():
        problems.add(f"that is a folder; name a file in it, such as {example}")
    elif path.exists() and not overwrite:
        replace = "pass {} to replace it"
        mend, option = (replace.format(text) for text in ("overwrite=True", "--overwrite"))
        problems.add("it exists already", mend=mend, option=option)
    if not path.absolute().parent.is_dir():
        problems.add(f"there is no folder {path.absolute().parent}")
    problems.raise_if_any()


def publish_file(path: Path, content: bytes, *, overwrite: bool) -> None:
    """Write a file whole or not at all, as `published_files`."""
    with published_files([path], overwrite=overwrite) as (temporary,):
        temporary.write_bytes(content)


@contextlib.contextmanager
def published_files(targets: Sequence[Path], *, overwrite: bool) -> Iterator[list[Path]]:
    """Yield a path to write for each file of a product; they get their places when the block ends well.

    The last file is what the product is opened by: it is the first to go, where another is replaced, and the
    last to appear, so that what is opened is always of one product.

    ``targets``: files of one folder; ``overwrite``: whether files that exist may be replaced.

    Raises `StoreError`: A file exists, or is being written by another process; or the system refuses. What
    was there stays.
    """
    key = targets[-1]
    _refuse_existing(targets, overwrite=overwrite)
    with _built(key) as (_, build):
        written = [build / target.name for target in targets]
        yield written
        flush_group(build, written)
        _refuse_existing(targets, overwrite=overwrite)
        with contextlib.suppress(FileNotFoundError):
            if len(targets) > 1:
                key.unlink()
        for path, target in zip(written, targets, strict=True):
            os.replace(path, target)
        sync(key.parent)


@contextlib.contextmanager
def published_folder(target: Path, *, overwrite: bool, foreign: Callable[[Path], str]) -> Iterator[Path]:
    """Yield a folder to fill, which gets its place when the block ends well.

    ``target``: its place, which is new, an empty folder, or an earlier product; ``overwrite``: whether an
    earlier product may be replaced; ``foreign``: returns what a folder that is not empty holds and this
    product does not, such as "other files", and nothing for an earlier product. What holds anything else is
    never replaced.

    Raises `StoreError`: The folder holds something else, or a product that may not be replaced, or is being
    written by another process; or the system refuses. What was there stays.
    """
    _refuse_folder(target, foreign, overwrite=overwrite)
    with _built(target) as (stage, build):
        yield build
        flush_group(build, [])
        _refuse_folder(target, foreign, overwrite=overwrite)
        stage.publish(build, "")


@contextlib.contextmanager
def _built(target: Path) -> Iterator[tuple[Staging, Path]]:
    """Yield a new folder beside a place, as its only writer; what is still there in the end is removed."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with staging(target) as stage:
            build = stage.build("", "product")
            build.mkdir(parents=True)
            try:
                yield stage, build
            finally:
                if build.exists():
                    discard(build)
    except OSError as error:
        if isinstance(error, StoreError):
            raise
        raise StoreError(f"{target} cannot be written: {error.strerror or error}") from error


def _refuse_existing(targets: Sequence[Path], *, overwrite: bool) -> None:
    existing = [target for target in targets if os.path.lexists(target)]
    if folders := [target for target in existing if target.is_dir()]:
        raise StoreError(f"{folders[0]} is a folder; choose another path")
    if existing and not overwrite:
        names = ", ".join(map(str, existing))
        found_there = f"{names} {'exists' if len(existing) == 1 else 'exist'}"
        raise StoreError(found_there, mend=_MEND.format("overwrite=True"), option=_MEND.format("--overwrite"))


def _refuse_folder(target: Path, foreign: Callable[[Path], str], *, overwrite: bool) -> None:
    if not os.path.lexists(target):
        return
    if target.is_symlink() or not target.is_dir():
        raise StoreError(f"{target} is a file or a link, expected a folder; choose another path")
    try:
        if not any(target.iterdir()):
            return
        other = foreign(target)
    except OSError as error:
        raise StoreError(f"{target} cannot be read: {error.strerror or error}") from error
    if other:
        raise StoreError(f"{target} holds {other}; choose a new or empty folder")
    if not overwrite:
        existing = f"{target} exists"
        raise StoreError(existing, mend=_MEND.format("overwrite=True"), option=_MEND.format("--overwrite"))
