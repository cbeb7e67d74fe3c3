"""Products that are written completely or not at all: a file, a folder, or several related files.

A product is built in a staging folder like a store's, ``.partial-<name>`` beside its place (see
`hyperpaint.io.store.writer`), flushed to the disk, then moved to its place. One file is moved by one rename.
One folder is exchanged with the old one, like a group of a store.

Several files are opened by the last of them, the key: the header of a cube, the map that an item describes.
They cannot be moved in one step, so the key is absent while its companions change:

1. Every old companion gets a second name in the build, by a link; it keeps its place.
2. The build, with a journal of all places, is renamed to ``swap``. Until here all old files stand.
3. The old key is moved into ``swap``. From here on there is no key to open.
4. New companions replace the old ones, one by one. Where the disk has no links, the old one is moved into
   ``swap`` first.
5. The new key is moved to its place. From here on all new files stand; ``swap`` is removed.

An error after step 2 undoes all steps at once. A process that is killed there leaves ``swap``: the next
writer of the product, or `check_place`, undoes the steps if the new key is still in ``swap``, else removes
it. So a key in its place has its own companions. Two cases remain: while there is no key, a companion that is
opened by itself may be the old or the new one; and a program that has opened the old key may read new
companions.

Companions in another folder have a staging folder there, with its own ``swap`` and journal. A journal changes
no folder without such a ``swap``, so that a planted journal reaches no other folder.
"""

import contextlib
import errno
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from hyperpaint.base import (
    FormatError,
    PaintError,
    Problem,
    Problems,
    StoreError,
    file_system,
    forget,
    is_plain_file,
    read_limited,
    url_of,
)
from hyperpaint.io.store import (
    Staging,
    discard,
    flush_group,
    size_text,
    staging,
    sync,
)

_SWAP, _JOURNAL = "swap", "journal"
MAX_JOURNAL_BYTES = 100_000
MAX_MARKER_BYTES = 256 * 2**20
_PROBE_BYTES = 2**20
_FULL = (errno.ENOSPC, errno.EDQUOT)


def check_place(
    path: Path,
    product: str,
    *,
    example: str,
    kinds: Sequence[str] = (),
    store: Path | None = None,
    overwrite: bool = False,
    error: type[PaintError] = StoreError,
) -> None:
    # Check the path of a new file before any input is read; all problems are listed.
    #
    # Messages name the ``product``, such as "the table", and an ``example`` of a name. ``kinds`` are the
    # allowed suffixes, any by default; the file may not be inside ``store``.
    problems = Problems(f"{product} cannot be written to {path}", error)
    is_local = url_of(path) is None
    with _errors_of(path):
        if is_local:
            _recover(path)
    folder = path.absolute().parent
    is_inside = store is not None and store.resolve() in (path.resolve(), *path.resolve().parents)
    problems.raise_if_any(
        (
            kinds and path.suffix.lower() not in kinds,
            Problem(
                f"the name ends in {path.suffix!r}",
                expected="one of " + ", ".join(kinds) if len(kinds) > 2 else " or ".join(kinds),
                code="suffix-unknown",
            ),
        ),
        (
            is_inside,
            Problem("the path is in the store itself", mend="choose another path", code="path-inside-store"),
        ),
        (
            path.is_dir() and not is_inside,
            Problem(
                "the path is a folder", mend=f"name a file in it, such as {example}", code="path-is-folder"
            ),
        ),
        (
            path.exists() and not (overwrite or is_inside or path.is_dir()),
            Problem(
                "the file exists",
                mend="pass overwrite=True to replace it",
                option="pass --overwrite to replace it",
                code="file-exists",
            ),
        ),
        (is_local and not folder.is_dir(), Problem(f"there is no folder {folder}", code="folder-missing")),
    )


def publish_file(path: Path, content: bytes, *, overwrite: bool) -> None:
    # Write a file completely or not at all, like `published_files`.
    with published_files([path], overwrite=overwrite) as (temporary,):
        temporary.write_bytes(content)


def foreign_content(
    folder: Path, product: str, *, marker: str, form: str, is_own: Callable[[str], object]
) -> str:
    # Return a description of content that is not of an earlier product, for `published_folder`.
    #
    # ``product``: the kind of folder, such as "a site"; ``marker``: its file of JSON whose ``format`` is
    # ``form``; ``is_own``: whether it may have a file or folder of a name.
    try:
        document = json.loads(read_limited(folder / marker, MAX_MARKER_BYTES, product))
    except (FormatError, OSError, ValueError, RecursionError):
        document = None
    if not isinstance(document, dict) or document.get("format") != form:
        return "other files"
    names = sorted(path.name for path in folder.iterdir() if not is_own(path.name))
    return f"{names[0]}, which is not part of {product}" if names else ""


@contextlib.contextmanager
def published_folder(target: Path, *, overwrite: bool, foreign: Callable[[Path], str]) -> Iterator[Path]:
    # Yield a new folder, which is moved to its path if the block succeeds; see `published_files`.
    with published_files([target], overwrite=overwrite, foreign=foreign) as (build,):
        build.mkdir()
        yield build


@contextlib.contextmanager
def published_files(
    targets: Sequence[Path], *, overwrite: bool, foreign: Callable[[Path], str] | None = None
) -> Iterator[list[Path]]:
    # Yield a temporary path per part of a product; parts are moved to their paths if the block succeeds.
    #
    # ``targets``: paths of the parts, in one or several folders; the last is the key, by which the product is
    # opened; ``overwrite``: whether an earlier product may be replaced; ``foreign``: passed if the last is a
    # folder, which must be new, empty, or an earlier product; returns a description of foreign content, such
    # as "other files", empty for an earlier product. Foreign content is never replaced.
    #
    # Raises `StoreError`: A path holds foreign content, or a product that may not be replaced, or is being
    # written by another process; or the system refuses. Existing files stay.
    if url_of(targets[-1]) is not None:
        with _uploaded(targets, foreign, overwrite=overwrite) as paths:
            yield paths
        return
    if len({target.parent for target in targets}) > 1:  # one spelling per folder
        targets = [Path(os.path.realpath(target.parent), target.name) for target in targets]
    key, anchors, builds = targets[-1], _anchors(targets), {}
    with _errors_of(key), contextlib.ExitStack() as stack:
        for anchor in anchors:
            _recover(anchor)
        _refuse(targets, foreign, overwrite=overwrite)
        for anchor in anchors:
            anchor.parent.mkdir(parents=True, exist_ok=True)
            stage = stack.enter_context(staging(anchor))
            builds[anchor.parent] = build = stage.build("", "product")
            stack.callback(discard, build)
            build.mkdir()
        temporary_paths = [
            builds[target.parent] / str(number) / target.name for number, target in enumerate(targets)
        ]
        for temporary_path in temporary_paths:
            temporary_path.parent.mkdir()
        yield temporary_paths
        for build in builds.values():
            flush_group(
                build,
                [
                    temporary_path
                    for temporary_path in temporary_paths
                    if build in temporary_path.parents and not temporary_path.is_dir()
                ],
            )
        _refuse(targets, foreign, overwrite=overwrite)
        if len(targets) > 1:
            _swap(targets, builds)
        elif temporary_paths[0].is_dir():
            stage.publish(temporary_paths[0], "")
        else:
            os.replace(temporary_paths[0], key)
            sync(key.parent)


@contextlib.contextmanager
def _uploaded(
    targets: Sequence[Path], foreign: Callable[[Path], str] | None, *, overwrite: bool
) -> Iterator[list[Path]]:
    # Yield temporary paths, which are uploaded if the block succeeds, the key last: a server replaces a file
    # in one step. What opens an old folder is removed first and uploaded last: its page and its metadata.
    _refuse(targets, foreign, overwrite=overwrite)
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, str(number), target.name) for number, target in enumerate(targets)]
        for path in paths:
            path.parent.mkdir()
        yield paths

        def is_opener(name: str) -> tuple[bool, bool, int]:
            return name.endswith(".html"), name.endswith("zarr.json"), -name.count("/")

        for path, target in zip(paths, targets, strict=True):
            forget(target)
            fs, key = file_system(os.fspath(target))
            files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
            new = {f"{key}/{file.relative_to(path).as_posix()}".removesuffix("/."): file for file in files}
            with StoreError.instead_of(
                Exception, f"{target} cannot be written: $kind: $error", code="file-unwritable"
            ):
                old = sorted(fs.find(key), key=is_opener, reverse=True) if path.is_dir() else []
                for name in old:
                    if name not in new or any(is_opener(name)[:2]):
                        fs.rm_file(name)
                for name in sorted(new, key=is_opener):
                    fs.put_file(str(new[name]), name)


def unwritable(place: Path, error: Exception) -> StoreError:
    # Return the error of a path that cannot be written; on a full disk with its free space.
    #
    # GDAL hides the error number of the system: a probe file shows whether the disk is full.
    folder = next((parent for parent in place.absolute().parents if parent.is_dir()), Path(place.anchor))
    reason: str = getattr(error, "strerror", None) or str(error)
    code = getattr(error, "errno", None)
    if code is None:
        try:
            with tempfile.TemporaryFile(dir=folder) as probe:
                probe.write(bytes(_PROBE_BYTES))
                probe.flush()
        except OSError as probe_error:
            code, reason = probe_error.errno, f"{probe_error.strerror} ({reason})"
    if code not in _FULL:
        return StoreError(f"{place} cannot be written: {reason}", code="file-unwritable")
    free = size_text(shutil.disk_usage(folder).free)
    return StoreError(
        f"{place} cannot be written: {reason}; {free} are free on the disk of {folder}",
        mend="make room, or choose another disk",
        code="disk-full",
    )


@contextlib.contextmanager
def _errors_of(path: Path) -> Iterator[None]:
    try:
        yield
    except PaintError:
        raise
    except OSError as error:
        raise unwritable(path, error) from error


def _refuse(targets: Sequence[Path], foreign: Callable[[Path], str] | None, *, overwrite: bool) -> None:
    existing = [
        target
        for target in targets
        if os.path.lexists(target) or (url_of(target) is not None and target.exists())
    ]
    for target in existing[:]:
        if foreign is None or target != targets[-1]:
            StoreError.raise_if(
                target.is_dir(), f"{target} is a folder", mend="choose another path", code="path-is-folder"
            )
            StoreError.raise_if(
                not target.is_symlink() and not target.is_file(),
                f"{target} is not a plain file",
                mend="choose another path",
                code="file-not-plain",
            )
        elif target.is_symlink() or not target.is_dir():
            raise StoreError(
                f"{target} is a file or a link",
                expected="a folder",
                mend="choose another path",
                code="path-not-folder",
            )
        else:
            with StoreError.instead_of(OSError, f"{target} cannot be read: $reason", code="file-unreadable"):
                is_empty = not any(target.iterdir())
                content = "" if is_empty else foreign(target)
            StoreError.raise_if(
                content,
                f"{target} holds {content}",
                mend="choose a new or empty folder",
                code="folder-occupied",
            )
            if is_empty:
                existing.remove(target)
    if existing and not overwrite:
        names = ", ".join(map(str, existing))
        raise StoreError(
            f"{names} {'exists' if len(existing) == 1 else 'exist'}",
            mend="pass overwrite=True, or choose another path",
            option="pass --overwrite, or choose another path",
            code="file-exists",
        )


# --- several files -----------------------------------------------------------------------------------------


def _anchors(targets: Sequence[Path]) -> list[Path]:
    # Return the target that names the staging folder of each folder, the key last.
    key = targets[-1]
    return [*{part.parent: part for part in targets if part.parent != key.parent}.values(), key]


def _swap(targets: Sequence[Path], folders: dict[Path, Path]) -> None:
    # Exchange new and old files: steps 1 to 5 of the module's docstring.
    #
    # ``folders``: the build of each target folder, the key's last.
    *companions, (last, key) = enumerate(targets)
    for number, target in companions:
        with contextlib.suppress(OSError):  # there is no old file, or the disk has no links
            os.link(target, _old(folders[target.parent], number))
    for folder, build in folders.items():
        real = os.path.realpath(folder)
        journal = [
            (os.path.relpath(os.path.realpath(target_path.parent), real), target_path.name)
            for target_path in targets
        ]
        (build / _JOURNAL).write_text(json.dumps(journal))
        sync(build / _JOURNAL)
        sync(build)
    try:
        for folder, build in folders.items():  # the key's folder comes last and begins the swap
            os.rename(build, build.with_name(_SWAP))
            sync(build.parent)
            folders[folder] = build.with_name(_SWAP)
        if os.path.lexists(key):
            os.rename(key, _old(folders[key.parent], last))
            sync(key.parent)
        for number, target in companions:
            old = _old(folders[target.parent], number)
            if os.path.lexists(target) and not os.path.lexists(old):
                os.rename(target, old)
            os.replace(_new(folders[target.parent], number, target), target)
        for folder in folders:
            sync(folder)
        os.rename(_new(folders[key.parent], last, key), key)
        sync(key.parent)
    except BaseException:
        with contextlib.suppress(OSError):  # otherwise done by the next writer
            _settle(targets)
        raise
    _settle(targets)


def _old(build: Path, number: int) -> Path:
    return build / f"{number}.old"


def _new(build: Path, number: int, target: Path) -> Path:
    return build / str(number) / target.name


def _settle(targets: Sequence[Path]) -> None:
    # Undo a swap whose key is not in its place yet, and remove its remains; the places are locked.
    swaps = {anchor.parent: Staging(anchor).folder / _SWAP for anchor in _anchors(targets)}
    *companions, (last, key) = enumerate(targets)
    folder = swaps[key.parent]
    if os.path.lexists(_new(folder, last, key)):
        for number, target in reversed(companions):
            swap = swaps[target.parent]
            old, is_there = _old(swap, number), os.path.lexists(target)
            if not swap.is_dir():
                continue
            if os.path.lexists(old):
                if not (is_there and os.path.samestat(os.lstat(old), os.lstat(target))):
                    os.replace(old, target)
            elif is_there and not os.path.lexists(_new(swap, number, target)):
                os.unlink(target)
            sync(target.parent)
        if os.path.lexists(_old(folder, last)) and not os.path.lexists(key):
            os.rename(_old(folder, last), key)
        sync(key.parent)
    for swap in reversed(swaps.values()):
        discard(swap)


def _recover(target: Path) -> None:
    # Undo or finish a swap that a killed writer left at a place.
    if not os.path.lexists(Staging(target).folder):
        return
    with staging(target):  # removes unfinished builds
        targets = _journal(target)
    with contextlib.ExitStack() as stack:
        for anchor in _anchors(targets) if targets else ():
            if Staging(anchor).folder.is_dir():
                stack.enter_context(staging(anchor))
        if targets:
            _settle(targets)


def _journal(target: Path) -> list[Path]:
    # The places of the files of an interrupted swap; StoreError for a journal that no writer left.
    path = Staging(target).folder / _SWAP / _JOURNAL
    if not os.path.lexists(path.parent):
        return []
    targets = []
    with StoreError.instead_of(
        (ValueError, TypeError, RecursionError, OSError),
        f"{path} is not the journal of a writer",
        mend="check its content, then remove it",
        code="staging-foreign",
    ):
        if path.parent.is_symlink() or not is_plain_file(path) or path.stat().st_size > MAX_JOURNAL_BYTES:
            raise ValueError
        for place, name in json.loads(path.read_bytes()):
            if name in ("", "..") or Path(name).name != name:
                raise ValueError
            folder = os.path.normpath(os.path.realpath(target.parent) + os.sep + place)
            targets.append(target.parent / name if place == "." else Path(folder, name))
        if target not in targets:
            raise ValueError
    return targets
