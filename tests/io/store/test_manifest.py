"""The manifest: what a store is to hold is what it holds, or the difference is named."""

import contextlib
import json
import os
import shutil
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import xarray as xr
import zarr
from support.refusals import expect_error, expect_errors, expect_words

import hyperpaint as hp
from hyperpaint.base.errors import IncompleteStoreError, PaintWarning, StoreError
from hyperpaint.io.store import is_complete, list_groups, open_group, reader, writer
from hyperpaint.io.store.manifest import (
    INPUTS,
    SETTINGS,
    ArrayEntry,
    GroupEntry,
    Location,
    Manifest,
    Write,
    content_of,
    entry_of,
)
from hyperpaint.io.store.reader import listed_documents
from hyperpaint.io.store.writer import run_contents, whole_run

LINES = ("flightlines/raw_0", "flightlines/raw_1", "flightlines/raw_2")
COMMAND = "hyperpaint process lot.toml --out {store}"


def line(value: int = 1) -> xr.Dataset:
    cube = np.full((8, 2, 3), value, "uint16")
    return xr.Dataset({"counts": (("along_track", "band", "cross_track"), cube)})


def run(
    path: Path, settings: str = "a", *, lines: tuple[str, ...] = LINES, stop: int | None = None,
    command: str = COMMAND, last: Callable[[], object] = bool,
) -> None:  # fmt: skip
    # Write lines as `process` does; stop before one of them, or call ``last`` after them
    value = 1 + ord(settings[0])
    named = {SETTINGS: settings}
    groups = {name: line(value).assign_attrs({INPUTS: f"{name}-{settings}", **named}) for name in lines}
    turns = whole_run(path, run_contents(groups), groups, {"name": "lot"}, command=command, overwrite=True)
    with contextlib.suppress(KeyboardInterrupt), turns as turn:
        for number, (name, dataset) in enumerate(groups.items()):
            if number == stop:
                raise KeyboardInterrupt
            turn.write(name, dataset)
        last()


def mend(path: Path, settings: str = "a") -> None:
    # Run again, after which the store is whole
    run(path, settings)
    assert hp.verify(path).ok


@pytest.fixture
def store(tmp_path: Path) -> Path:
    run(tmp_path / "lot.zarr")
    return tmp_path / "lot.zarr"


def problems(path: Path) -> str:
    report = hp.verify(path)
    assert not report.ok
    expect_error(IncompleteStoreError, None, lambda: hp.open_store(path))
    return "\n".join(report.problems)


def consolidate(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(path)


def manifest(path: Path) -> Manifest:
    found = Manifest.read(Location.of(path))
    assert found is not None
    return found


def test_a_whole_run_is_whole_and_can_be_moved(store: Path, tmp_path: Path) -> None:
    assert hp.verify(store).ok
    os.rename(store, tmp_path / "elsewhere.zarr")
    moved = tmp_path / "elsewhere.zarr"
    assert hp.verify(moved).ok
    assert is_complete(moved, LINES[0])
    assert set(hp.open_store(moved)["flightlines"].children) == {"raw_0", "raw_1", "raw_2"}
    assert hp.open_store(moved, LINES[0]).counts.values[0, 0, 0] == 98
    consolidate(moved)
    assert hp.verify(moved).ok
    assert not {"hyperpaint_content", SETTINGS} & set(hp.open_store(moved, LINES[0]).attrs)


def test_the_manifest_names_what_lies_on_the_disk(store: Path) -> None:
    # What the writer noted as it went along is what its files say
    location = Location.of(store)
    entries = manifest(store).groups
    assert set(entries) == {"", "flightlines", *LINES}
    for name, entry in entries.items():
        assert entry == entry_of(location, name) or not entry.arrays
    assert manifest(store).writes == ()
    ours = listed_documents(location)
    consolidate(store)
    theirs = listed_documents(location)
    assert {name: node for name, node in theirs.items() if name != "hyperpaint"} == ours
    assert list(ours) == [name for name in theirs if name != "hyperpaint"]


@pytest.mark.parametrize("stop", [1, 2])
def test_a_run_that_was_cut_short_is_unfinished(stop: int, path: Path) -> None:
    run(path, stop=stop)
    expect_words(
        problems(path),
        f"unfinished: {stop} of 3 groups are written",
        f"to finish it: hyperpaint process lot.toml --out {path}",
    )
    assert hp.verify(path).resume == f"hyperpaint process lot.toml --out {path}"
    expect_error(IncompleteStoreError, "store-unfinished", lambda: hp.open_store(path, LINES[0]))
    assert open_group(path, LINES[0]).counts.values[0, 0, 0] == 98
    mend(path)


def test_two_half_runs_are_not_whole(store: Path) -> None:
    run(store, "b", stop=0)
    assert hp.verify(store).ok  # nothing had been replaced yet
    run(store, "b", stop=1)
    expect_words(problems(store), "unfinished: 1 of 3", "/flightlines/raw_1, /flightlines/raw_2")
    expect_error(IncompleteStoreError, None, lambda: hp.open_store(store, LINES[1]))
    mend(store, "b")


def test_a_deleted_group_is_missed(store: Path) -> None:
    shutil.rmtree(store / LINES[1])
    consolidate(store)
    said = problems(store)
    assert said.startswith(f"/{LINES[1]}: deleted")
    assert "\n" not in said
    # of the other lines each is what it was
    assert hp.open_store(store, LINES[0]).counts.values[0, 0, 0] == 98
    mend(store)


def test_swapped_groups_are_told(store: Path) -> None:
    for old, new in ((LINES[0], "moved"), (LINES[1], LINES[0]), ("moved", LINES[1])):
        os.rename(store / old, store / new)
    consolidate(store)
    assert f"/{LINES[0]}: changed" in problems(store)
    expect_error(IncompleteStoreError, "group-changed", lambda: open_group(store, LINES[0]))
    mend(store)


def test_a_group_of_another_store_is_foreign(store: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.zarr"
    run(other, "b", lines=(*LINES, "flightlines/raw_3"))
    shutil.copytree(other / "flightlines/raw_3", store / "flightlines/raw_3")
    shutil.rmtree(store / LINES[0])
    shutil.copytree(other / LINES[0], store / LINES[0])
    consolidate(store)
    expect_words(problems(store), f"/{LINES[0]}: changed", without=("raw_3",))
    assert any("/flightlines/raw_3: added by another program" in note for note in hp.verify(store).notes)
    expect_error(IncompleteStoreError, None, lambda: hp.open_store(store, LINES[0]))
    # what others add is opened
    assert hp.open_store(store, "flightlines/raw_3").counts.values[0, 0, 0] == 99


def test_what_a_user_adds_is_of_the_store(store: Path) -> None:
    assert hp.verify(hp.to_store(line(7), store, "signatures")).ok
    assert set(manifest(store).groups) == {"", "flightlines", *LINES, "signatures"}
    mend(store, "b")
    shutil.rmtree(store / "signatures")
    assert "/signatures: deleted" in problems(store)
    hp.to_store(line(8), store, LINES[0], overwrite=True)
    assert "/signatures: deleted" in problems(store)
    mend(store, "b")  # forgets what is gone


def test_a_deleted_group_is_forgotten_on_demand_only(store: Path) -> None:
    shutil.rmtree(store / LINES[1])
    hp.to_store(line(7), store, "signatures", overwrite=True)
    run(store, lines=("renders/clear",), command="hyperpaint render car.toml --out {store}")
    expect_words(problems(store), f"/{LINES[1]}: deleted", "run its command with --overwrite")
    assert hp.verify(hp.to_store(xr.Dataset(), store, LINES[1])).ok


def test_groups_without_variables_are_of_the_store(store: Path) -> None:
    hp.to_store(xr.Dataset(attrs={"a": 1}), store, "meta")
    assert hp.verify(hp.to_store(line(7), store, "signatures")).ok
    hp.open_store(store)
    shutil.rmtree(store / LINES[1] / "counts")
    assert "counts: the array is missing" in problems(store)


def test_a_half_written_tree_is_finished_by_itself_alone(store: Path) -> None:
    tree = xr.DataTree.from_dict({"/sig/a": line(1), "/sig/b": line(2)})
    publish, calls = writer.Staging.publish, iter([True])

    def killed(self: Any, *arguments: Any) -> None:
        if not next(calls, False):
            raise KeyboardInterrupt
        publish(self, *arguments)

    with mock.patch.object(writer.Staging, "publish", killed):
        expect_error(KeyboardInterrupt, None, lambda: hp.to_store(tree, store))
    hp.to_store(line(9), store, "other")
    for _ in range(2):
        expect_words(
            problems(store),
            "unfinished: 1 of 2 groups are written, without /sig/b; run its writer again",
            without=("lot.toml",),
        )
        # other groups are what they were
        for group in (LINES[0], "other"):
            assert hp.open_store(store, group).sizes["band"] == 2
        expect_errors(
            (IncompleteStoreError, "/sig/b", lambda: hp.open_store(store, "sig/a")),
            (IncompleteStoreError, "/sig/b", lambda: run(store)),
        )
    assert hp.verify(hp.to_store(tree, store)).ok


def test_a_run_does_not_finish_another(path: Path) -> None:
    run(path, stop=1)
    expect_error(
        IncompleteStoreError,
        "store-unfinished",
        lambda: run(path, lines=("renders/clear",), command="hyperpaint render car.toml --out {store}"),
    )
    assert "to finish it: hyperpaint process lot.toml" in problems(path)
    mend(path)


def test_a_run_that_could_not_be_sealed_says_so(path: Path) -> None:
    expect_error(
        IncompleteStoreError,
        "store-unfinished",
        lambda: run(path, last=lambda: shutil.rmtree(path / LINES[0])),
    )
    mend(path)


def test_texts_of_a_manifest_do_no_harm(store: Path) -> None:
    contents = {f"\x1b[2J{number}": f"/\x1b[2J{number} x" for number in range(30)}
    entries = {name: GroupEntry(content, 0, {}) for name, content in contents.items()}
    for command in ("rm -rf {store}", "hyperpaint process \x1b[2J", "hyperpaint run " + "x" * 3000):
        for found in (Manifest(entries, (), command), Manifest({}, (Write(contents, command),))):
            found.write(Location.of(store))
            report = hp.verify(store)
            assert not report.ok
            assert not report.resume
            assert len(report.problems) < 30
            assert "".join(report.problems).isprintable()


def test_what_came_from_another_store_is_whole_where_it_goes(store: Path, tmp_path: Path) -> None:
    # Attributes travel with a dataset; those that say of which run it is are the old store's
    counts = hp.open_store(store, LINES[0])
    hp.to_store(xr.DataTree.from_dict({f"/{LINES[1]}": counts}), tmp_path / "tree.zarr")
    hp.to_store(counts, tmp_path / "one.zarr", "counts")
    for name in ("tree.zarr", "one.zarr"):
        report = hp.verify(tmp_path / name)
        assert report.ok, str(report)


def test_what_a_user_adds_does_not_finish_a_run(path: Path) -> None:
    run(path, stop=1)
    hp.to_store(line(7), path, "signatures")
    hp.to_store(line(8), path, "signatures", overwrite=True)
    assert "unfinished: 1 of 3" in problems(path)
    mend(path)
    assert set(list_groups(path)) == {*LINES, "signatures"}


@pytest.mark.parametrize("group", ["signatures", LINES[0]])
@pytest.mark.parametrize("point", ["publish", "finish"])
def test_one_group_more_leaves_the_store_whole_at_every_instant(group: str, point: str, store: Path) -> None:
    target = {"publish": "writer.Staging.publish", "finish": "writer.StoreWriter.finish"}[point]
    with mock.patch(f"hyperpaint.io.store.{target}", side_effect=KeyboardInterrupt):
        expect_error(KeyboardInterrupt, None, lambda: hp.to_store(line(7), store, group, overwrite=True))
    assert hp.open_store(store, LINES[1]).counts.values[0, 0, 0] == 98
    hp.open_store(store)
    assert [text for text in hp.verify(store).problems if "listing-missing" not in text] == []
    assert hp.verify(hp.to_store(line(9), store, "other")).ok
    assert hp.verify(hp.to_store(line(7), store, group, overwrite=True)).ok


def test_what_is_written_while_a_store_is_read_is_said(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = reader.store_state

    def state_and_run(*arguments: Any) -> Any:
        found = state(*arguments)
        run(store, "b", stop=2)
        return found

    monkeypatch.setattr(reader, "store_state", state_and_run)
    assert "a writer changed the store" in hp.verify(store).problems[0]


def test_a_tree_is_whole_when_all_of_it_is_there(path: Path, tmp_path: Path) -> None:
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs={"name": "lot"}), "/a": line(1), "/b/c": line(2)})
    with mock.patch.object(writer.StoreWriter, "finish", side_effect=KeyboardInterrupt):
        expect_error(KeyboardInterrupt, None, lambda: hp.to_store(tree, path))
    assert hp.open_store(path, "a").counts.values[0, 0, 0] == 1  # each is there; the list in the root is not
    assert hp.verify(hp.to_store(tree, path)).ok
    assert hp.verify(hp.to_store(hp.open_store(path), tmp_path / "copy.zarr")).ok


def test_a_root_with_arrays_names_the_groups_below(path: Path, tmp_path: Path) -> None:
    assert hp.verify(hp.to_store(xr.DataTree.from_dict({"/": line(1), "/a": line(2)}), path)).ok
    alone = tmp_path / "alone.zarr"
    assert hp.verify(hp.to_store(line(1), alone)).ok
    assert hp.verify(hp.to_store(line(2), alone, "a")).ok
    for each in (path, alone):
        assert hp.open_store(each).counts.values[0, 0, 0] == 1
        shutil.rmtree(each / "a")
        assert not hp.verify(each).ok


def test_a_huge_list_in_the_root_is_not_read(store: Path) -> None:
    document = json.loads((store / "zarr.json").read_text())
    (store / "zarr.json").write_text(json.dumps({key: document[key] for key in reversed(document)}))
    assert len(hp.open_store(store)["flightlines"].children) == 3
    document["consolidated_metadata"]["metadata"]["long"] = "x" * 33 * 2**20
    (store / "zarr.json").write_text(json.dumps(document))
    assert hp.open_store(store, LINES[0]).counts.values[0, 0, 0] == 98
    expect_error(IncompleteStoreError, "file-too-large", lambda: hp.verify(store))


def test_a_lost_manifest_is_told_and_made_again(store: Path) -> None:
    before = manifest(store)
    shutil.rmtree(store / "hyperpaint")
    assert "is missing" in hp.verify(store).problems[0]
    assert not is_complete(store, LINES[0])
    assert hp.open_store(store, LINES[0]).counts.values[0, 0, 0] == 98
    expect_error(StoreError, "manifest-lost", lambda: hp.to_store(line(7), store, "signatures"))
    assert hp.verify(hp.to_store(line(7), store, "signatures", overwrite=True)).ok
    made = manifest(store)
    assert {name: made.groups[name] for name in LINES} == {name: before.groups[name] for name in LINES}


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [("raw_2", "raw_9", "manifest-damaged"), ('"crc32c": ', '"crc32c": 1', "manifest-damaged"),
     ('"groups"', '"groupz"', "manifest-damaged"), ("{", "[", "metadata-damaged"),
     ("", "{", "metadata-damaged"), ("", "[]", "metadata-damaged"), ("", "[" * 100_000, "metadata-damaged")],
)  # fmt: skip
def test_a_damaged_manifest_is_told(old: str, new: str, code: str, store: Path) -> None:
    place = store / "hyperpaint/zarr.json"
    place.write_text(place.read_text().replace(old, new) if old else new)
    assert "is damaged" in problems(store)
    for act in (lambda: hp.open_store(store, LINES[0]), lambda: hp.to_store(line(7), store, "signatures")):
        expect_error(hp.PaintError, code, act)
    mend(store)


def test_manifests_survive_their_document() -> None:
    entry = GroupEntry("/a x y", 1, {"counts": ArrayEntry(2, 3, "0f")})
    found = Manifest({"a": entry}, (Write({"b": "/b z"}, "c"),), "hyperpaint process")
    document = json.loads(json.dumps(found.document()))
    assert Manifest.from_document(document, "here") == found
    for wrong in ({}, {**document, "zarr_format": 2}, {**document, "attributes": {"hyperpaint_format": 99}}):
        expect_error(IncompleteStoreError, "manifest-damaged", partial(Manifest.from_document, wrong, "here"))


def test_a_part_of_a_store_opens_and_says_so(store: Path, tmp_path: Path) -> None:
    for path, group in ((store / LINES[0], ""), (store / "flightlines", "raw_0")):
        assert hp.open_store(path, group).counts.values[0, 0, 0] == 98
    shutil.copytree(store / "flightlines", tmp_path / "flightlines")
    report = hp.verify(tmp_path / "flightlines")
    assert report.ok
    assert "copied from a store of hyperpaint" in report.notes[0]
    assert report.chunks == 3


def test_an_array_that_others_add_is_a_note(store: Path) -> None:
    index = xr.Dataset({"ndvi": (("along_track", "cross_track"), np.ones((8, 3)))})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        index.to_zarr(store, group=LINES[0], mode="a")
    assert INPUTS not in xr.open_zarr(store, group=LINES[0]).attrs  # xarray replaces them
    with pytest.warns(PaintWarning, match="attributes-replaced"):
        opened = hp.open_store(store, LINES[0])
    assert "ndvi" in opened
    assert opened.attrs[INPUTS] == f"{LINES[0]}-a"
    report = hp.verify(store)
    assert report.ok, str(report)
    assert [note.partition(":")[0] for note in report.notes] == [f"/{LINES[0]}", f"/{LINES[0]}/ndvi"]
    assert "added by another program" in report.notes[1]
    with whole_run(store, run_contents({}), {}, {}, command="hyperpaint render x", overwrite=False):
        pass
    with pytest.warns(PaintWarning, match="attributes-replaced"):
        assert "ndvi" in hp.open_store(store, LINES[0])


def test_nothing_is_written_where_all_is_there(store: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in store.rglob("*")}
    contents = {name: content_of(Location.of(store), name) for name in LINES}
    with whole_run(store, contents, {}, {"name": "lot"}, command=COMMAND, overwrite=True):
        pass
    assert {path: path.stat().st_mtime_ns for path in store.rglob("*")} == before
    assert content_of(Location.of(store), LINES[0]) == f"/{LINES[0]} {LINES[0]}-a a"


def test_attributes_that_others_add_to_a_root_with_arrays_refuse_nothing(tmp_path: Path) -> None:
    path = hp.to_store(line(1), tmp_path / "lot.zarr")
    zarr.open_group(path).attrs["note"] = "of a user"
    hp.to_store(line(2), path, "a")
    assert hp.open_store(path, "").attrs["note"] == "of a user"
    report = hp.verify(path)
    assert report.ok, str(report)


@pytest.mark.parametrize("name", ["zarr.json", "hyperpaint/zarr.json", f"{LINES[0]}/zarr.json"])
def test_a_document_cut_in_half_is_a_line_of_the_report(name: str, store: Path) -> None:
    whole = (store / name).read_bytes()
    (store / name).write_bytes(whole[: len(whole) // 2])
    assert any("damaged" in problem or "cannot be read" in problem for problem in hp.verify(store).problems)
    mend(store)
