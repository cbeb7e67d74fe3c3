"""The root record: what a store is to hold is what it holds, or the difference is named."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr

import hyperpaint as hp
from hyperpaint.base.errors import IncompleteStoreError, PaintWarning, StoreError
from hyperpaint.io.store import list_groups, open_group, reader, stage, verification
from hyperpaint.io.store.groups import INPUTS
from hyperpaint.io.store.location import Location
from hyperpaint.io.store.root_record import Member, SetRecord, read_set
from hyperpaint.io.store.store_runs import whole_run

LINES = ("flightlines/raw_0", "flightlines/raw_1", "flightlines/raw_2")
COMMAND = "hyperpaint process lot.toml --out {store}"


def line(value: int = 1) -> xr.Dataset:
    cube = np.full((8, 2, 3), value, "uint16")
    return xr.Dataset({"counts": (("along_track", "band", "cross_track"), cube)})


def run(
    path: Path, settings: str = "a", *, lines: tuple[str, ...] = LINES, stop: int | None = None,
    command: str = COMMAND, last: Callable[[], object] = bool,
) -> None:  # fmt: skip
    """Write lines as `process` does; stop before one of them, or call ``last`` after them."""
    value = 1 + ord(settings[0])
    groups = {name: line(value).assign_attrs({INPUTS: f"{name}-{settings}"}) for name in lines}
    members = {name: Member(f"{name}-{settings}", settings) for name in lines}
    turns = whole_run(path, members, groups, {"name": "lot"}, command=command, overwrite=True)
    with contextlib.suppress(KeyboardInterrupt), turns as turn:
        for number, (name, dataset) in enumerate(groups.items()):
            if number == stop:
                raise KeyboardInterrupt
            turn.write(name, dataset)
        last()


@pytest.fixture
def store(tmp_path: Path) -> Path:
    run(tmp_path / "lot.zarr")
    return tmp_path / "lot.zarr"


def problems(path: Path) -> str:
    report = hp.verify(path)
    assert not report.ok
    with pytest.raises(IncompleteStoreError):
        hp.open_store(path)
    return "\n".join(report.problems)


def consolidate(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(path)


def root(path: Path) -> dict[str, Any]:
    return dict(json.loads((path / "zarr.json").read_text())["attributes"])


def test_a_whole_run_is_whole_and_can_be_moved(store: Path, tmp_path: Path) -> None:
    assert hp.verify(store).ok
    os.rename(store, tmp_path / "elsewhere.zarr")
    moved = tmp_path / "elsewhere.zarr"
    assert hp.verify(moved).ok
    assert set(hp.open_store(moved)["flightlines"].children) == {"raw_0", "raw_1", "raw_2"}
    assert hp.open_store(moved, LINES[0]).counts.values[0, 0, 0] == 98
    consolidate(moved)
    assert hp.verify(moved).ok
    assert "hyperpaint_set" not in hp.open_store(moved, LINES[0]).attrs


@pytest.mark.parametrize("stop", [1, 2])
def test_a_run_that_was_cut_short_is_unfinished(stop: int, tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    run(path, stop=stop)
    said = problems(path)
    assert f"unfinished: {stop} of 3 groups are there" in said
    assert f"to finish it: hyperpaint process lot.toml --out {path}" in said
    assert hp.verify(path).resume == f"hyperpaint process lot.toml --out {path}"
    with pytest.raises(IncompleteStoreError, match=r"unfinished.*lot\.toml"):
        hp.open_store(path, LINES[0])
    assert open_group(path, LINES[0]).counts.values[0, 0, 0] == 98
    run(path)
    assert hp.verify(path).ok


def test_two_half_runs_are_not_whole(store: Path) -> None:
    run(store, "b", stop=0)
    assert hp.verify(store).ok  # nothing had been replaced yet
    run(store, "b", stop=1)
    said = problems(store)
    assert "unfinished: 1 of 3" in said
    assert "/flightlines/raw_1, /flightlines/raw_2" in said
    with pytest.raises(IncompleteStoreError):
        hp.open_store(store, LINES[1])
    run(store, "b")
    assert hp.verify(store).ok


def test_a_deleted_group_is_missed(store: Path) -> None:
    shutil.rmtree(store / LINES[1])
    consolidate(store)
    said = problems(store)
    assert said.startswith(f"/{LINES[1]}: deleted: the store's record names it, but it is not there")
    assert "\n" not in said
    # of the other lines each is what it was
    assert hp.open_store(store, LINES[0]).counts.values[0, 0, 0] == 98
    run(store)
    assert hp.verify(store).ok


def test_swapped_groups_are_told(store: Path) -> None:
    for old, new in ((LINES[0], "moved"), (LINES[1], LINES[0]), ("moved", LINES[1])):
        os.rename(store / old, store / new)
    consolidate(store)
    said = problems(store)
    assert f"/{LINES[0]}: swapped or copied: by its own record it is /{LINES[1]}" in said
    with pytest.raises(IncompleteStoreError, match="by its own record it is"):
        open_group(store, LINES[0])
    run(store)
    assert hp.verify(store).ok


def test_a_group_of_another_store_is_foreign(store: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.zarr"
    run(other, "b", lines=(*LINES, "flightlines/raw_3"))
    shutil.copytree(other / "flightlines/raw_3", store / "flightlines/raw_3")
    shutil.rmtree(store / LINES[0])
    shutil.copytree(other / LINES[0], store / LINES[0])
    consolidate(store)
    said = problems(store)
    assert "/flightlines/raw_3: foreign" in said
    assert f"/{LINES[0]}: mixed settings" in said
    for group in (LINES[0], "flightlines/raw_3"):
        with pytest.raises(IncompleteStoreError):
            hp.open_store(store, group)


def test_what_a_user_adds_is_of_the_store(store: Path) -> None:
    hp.to_store(line(7), store, "signatures")
    assert hp.verify(store).ok
    assert set(read_set(Location.of(store)).groups) == {*LINES, "signatures"}  # type: ignore[union-attr]
    run(store, "b")
    assert hp.verify(store).ok
    shutil.rmtree(store / "signatures")
    assert "/signatures: deleted" in problems(store)
    hp.to_store(line(8), store, LINES[0], overwrite=True)
    assert "/signatures: deleted" in problems(store)
    run(store, "b")  # forgets what is gone
    assert hp.verify(store).ok


def test_a_deleted_group_is_forgotten_on_demand_only(store: Path) -> None:
    shutil.rmtree(store / LINES[1])
    hp.to_store(line(7), store, "signatures", overwrite=True)
    run(store, lines=("renders/clear",), command="hyperpaint render car.toml --out {store}")
    said = problems(store)
    assert f"/{LINES[1]}: deleted" in said
    assert "run its command with --overwrite, which forgets what is gone, or say that it is empty" in said
    hp.to_store(xr.Dataset(), store, LINES[1])
    assert hp.verify(store).ok


def test_groups_without_variables_are_of_the_store(store: Path) -> None:
    hp.to_store(xr.Dataset(attrs={"a": 1}), store, "meta")
    hp.to_store(line(7), store, "signatures")
    assert hp.verify(store).ok
    hp.open_store(store)
    shutil.rmtree(store / LINES[1] / "counts")
    assert f"/{LINES[1]}: deleted" in problems(store)


def _publish_once(monkeypatch: pytest.MonkeyPatch) -> None:
    publish, calls = stage.Staging.publish, iter([True])

    def killed(self: Any, *arguments: Any) -> None:
        if not next(calls, False):
            raise KeyboardInterrupt
        publish(self, *arguments)

    monkeypatch.setattr(stage.Staging, "publish", killed)


def test_a_half_written_tree_is_finished_by_itself_alone(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = xr.DataTree.from_dict({"/sig/a": line(1), "/sig/b": line(2)})
    with monkeypatch.context() as patch:
        _publish_once(patch)
        with pytest.raises(KeyboardInterrupt):
            hp.to_store(tree, store)
    hp.to_store(line(9), store, "other")
    for _ in range(2):
        said = problems(store)
        assert "unfinished: 5 of 6 groups are there; lacking, or of other settings: /sig/b; to finish" in said
        assert "lot.toml" not in said
        # other groups are what they were
        for group in (LINES[0], "other"):
            assert hp.open_store(store, group).sizes["band"] == 2
        with pytest.raises(IncompleteStoreError, match="/sig/b"):
            hp.open_store(store, "sig/a")
        with pytest.raises(IncompleteStoreError, match="/sig/b"):
            run(store)
    hp.to_store(tree, store)
    assert hp.verify(store).ok


def test_a_run_does_not_finish_another(tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    run(path, stop=1)
    with pytest.raises(IncompleteStoreError, match="unfinished: 2 of 4"):
        run(path, lines=("renders/clear",), command="hyperpaint render car.toml --out {store}")
    assert "to finish it: hyperpaint process lot.toml" in problems(path)
    run(path)
    assert hp.verify(path).ok


def test_a_run_that_could_not_be_sealed_says_so(tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    with pytest.raises(IncompleteStoreError, match="unfinished: 2 of 3"):
        run(path, last=lambda: shutil.rmtree(path / LINES[0]))
    run(path)
    assert hp.verify(path).ok


def test_texts_of_a_record_do_no_harm(store: Path) -> None:
    groups = {f"\x1b[2J{number}": Member("x") for number in range(30)}
    for command in ("rm -rf {store}", "hyperpaint process \x1b[2J", "hyperpaint run " + "x" * 3000):
        record = SetRecord(groups, command=command, run=tuple(groups))
        document = json.loads((store / "zarr.json").read_text())
        for each in (record, replace(record, finished=True)):
            document["attributes"]["hyperpaint_set"] = each.text
            (store / "zarr.json").write_text(json.dumps(document))
            report = hp.verify(store)
            assert not report.resume
            assert len(report.problems) < 30
            assert "".join(report.problems).isprintable()


def test_what_came_from_another_store_is_whole_where_it_goes(store: Path, tmp_path: Path) -> None:
    """Attributes travel with a dataset; those that say of which run it is are the old store's."""
    counts = hp.open_store(store, LINES[0])
    hp.to_store(xr.DataTree.from_dict({f"/{LINES[1]}": counts}), tmp_path / "tree.zarr")
    hp.to_store(counts, tmp_path / "one.zarr", "counts")
    for name in ("tree.zarr", "one.zarr"):
        report = hp.verify(tmp_path / name)
        assert report.ok, str(report)


def test_what_a_user_adds_does_not_finish_a_run(tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    run(path, stop=1)
    hp.to_store(line(7), path, "signatures")
    hp.to_store(line(8), path, "signatures", overwrite=True)
    assert "unfinished: 2 of 4" in problems(path)
    run(path)
    assert hp.verify(path).ok
    assert set(list_groups(path)) == {*LINES, "signatures"}


@pytest.mark.parametrize("group", ["signatures", LINES[0]])
@pytest.mark.parametrize("point", ["publish", "finish"])
def test_one_group_more_leaves_the_store_whole_at_every_instant(
    group: str, point: str, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = {"publish": "stage.Staging.publish", "finish": "writer.finish_root"}[point]
    with monkeypatch.context() as patch:
        patch.setattr(f"hyperpaint.io.store.{target}", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            hp.to_store(line(7), store, group, overwrite=True)
    assert hp.open_store(store, LINES[1]).counts.values[0, 0, 0] == 98
    hp.open_store(store)
    assert [text for text in hp.verify(store).problems if "consolidated" not in text] == []
    hp.to_store(line(9), store, "other")
    assert hp.verify(store).ok
    hp.to_store(line(7), store, group, overwrite=True)
    assert hp.verify(store).ok


def test_what_is_written_while_a_store_is_read_is_said(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root_problems = verification._root_problems

    def root_problems_and_run(*arguments: Any) -> Any:
        yield from root_problems(*arguments)
        run(store, "b", stop=2)

    with monkeypatch.context() as patch:
        patch.setattr(verification, "_root_problems", root_problems_and_run)
        assert "was written to meanwhile" in hp.verify(store).problems[0]
    run(store)
    check = reader.check_set

    def check_and_add(*arguments: Any) -> Any:
        notes = check(*arguments)
        if not (store / "signatures").exists():
            hp.to_store(line(7), store, "signatures")
        return notes

    monkeypatch.setattr(reader, "check_set", check_and_add)
    assert "signatures" in hp.open_store(store).children  # it was opened once more


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def test_a_tree_is_whole_when_all_of_it_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "lot.zarr"
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs={"name": "lot"}), "/a": line(1), "/b/c": line(2)})
    with monkeypatch.context() as patch:
        patch.setattr("hyperpaint.io.store.writer.finish_root", _interrupt)
        with pytest.raises(KeyboardInterrupt):
            hp.to_store(tree, path)
    assert "unfinished: 2 of 2 groups are there, but it was not sealed" in problems(path)
    hp.to_store(tree, path)
    assert hp.verify(path).ok
    stored = hp.open_store(path)
    hp.to_store(stored, tmp_path / "copy.zarr")
    assert hp.verify(tmp_path / "copy.zarr").ok


def test_a_root_with_arrays_names_the_groups_below(tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    hp.to_store(xr.DataTree.from_dict({"/": line(1), "/a": line(2)}), path)
    assert hp.verify(path).ok
    alone = tmp_path / "alone.zarr"
    hp.to_store(line(1), alone)
    assert "hyperpaint_set" not in root(alone)
    hp.to_store(line(2), alone, "a")
    assert hp.verify(alone).ok
    for each in (path, alone):
        assert hp.open_store(each).counts.values[0, 0, 0] == 1
        shutil.rmtree(each / "a")
        assert not hp.verify(each).ok


def test_however_long_the_list_in_the_root_groups_are_opened(store: Path) -> None:
    document = json.loads((store / "zarr.json").read_text())
    turned = {key: document[key] for key in reversed(document)}
    (store / "zarr.json").write_text(json.dumps(turned))
    assert len(hp.open_store(store)["flightlines"].children) == 3
    document["consolidated_metadata"]["metadata"]["long"] = "x" * 33 * 2**20
    (store / "zarr.json").write_text(json.dumps(document))
    assert hp.open_store(store, LINES[0]).counts.values[0, 0, 0] == 98
    assert len(hp.open_store(store)["flightlines"].children) == 3
    assert "larger than" in hp.verify(store).problems[0]


def _without_record(path: Path) -> None:
    document = json.loads((path / "zarr.json").read_text())
    del document["attributes"]["hyperpaint_set"]
    (path / "zarr.json").write_text(json.dumps(document))


def _with_other_record(path: Path) -> None:
    document = json.loads((path / "zarr.json").read_text())
    document["attributes"]["hyperpaint_set"] = root(path)["hyperpaint_set"].replace("raw_2", "raw_9")
    (path / "zarr.json").write_text(json.dumps(document))


@pytest.mark.parametrize("damage", [_without_record, _with_other_record])
def test_a_record_that_is_gone_or_damaged_is_told(damage: Any, store: Path) -> None:
    damage(store)
    said = problems(store)
    assert "lost the record" in said or "is damaged" in said
    with pytest.raises(IncompleteStoreError):
        hp.open_store(store, LINES[0])
    with pytest.raises(StoreError, match="record of the groups"):
        hp.to_store(line(7), store, "signatures", overwrite=True)
    run(store)
    assert hp.verify(store).ok


def test_records_survive_their_text() -> None:
    groups = {"a": Member("x", "y"), "b": Member("u")}
    record = SetRecord(groups, before={"a": None, "b": Member("z")}, command="c", run=("a",))
    assert SetRecord.from_text(record.text, "here") == record
    for wrong in (
        "",
        record.text[:-1],
        record.text.replace("x", "q"),
        "crc32c=00000000 {}",
        replace(record, groups={}).text,
    ):
        with pytest.raises(IncompleteStoreError, match="here is damaged"):
            SetRecord.from_text(wrong, "here")


def test_a_group_is_opened_by_its_own_folder(store: Path) -> None:
    assert hp.open_store(store / LINES[0]).counts.values[0, 0, 0] == 98
    assert hp.open_store(store / "flightlines", "raw_0").counts.values[0, 0, 0] == 98
    link = store.with_name("link")
    os.symlink(store / "flightlines", link)
    for path in (store / "flightlines", link):
        assert hp.open_store(path, "raw_0").counts.values[0, 0, 0] == 98
        assert set(hp.open_store(path).children) == {"raw_0", "raw_1", "raw_2"}


def test_a_part_is_as_whole_as_its_store(tmp_path: Path) -> None:
    path = tmp_path / "lot.zarr"
    run(path, stop=2)
    for part, group in (
        (path / "flightlines", None),
        (path / "flightlines", "raw_0"),
        (path / LINES[0], None),
    ):
        with pytest.raises(IncompleteStoreError, match=r"unfinished: 2 of 3.*lot\.toml"):
            hp.open_store(part, group)
    assert f"of {path}: unfinished: 2 of 3" in hp.verify(path / "flightlines").problems[0]
    shutil.copytree(path / "flightlines", tmp_path / "flightlines")
    with pytest.warns(PaintWarning, match="is a part of a store, without its root"):
        hp.open_store(tmp_path / "flightlines")
    shutil.copytree(path / LINES[0], tmp_path / "one.zarr")
    assert hp.open_store(tmp_path / "one.zarr").counts.values[0, 0, 0] == 98


def test_a_copied_part_with_swapped_groups_is_not_whole(store: Path, tmp_path: Path) -> None:
    copy = tmp_path / "c.zarr"
    shutil.copytree(store / "flightlines", copy)
    for old, new in (("raw_0", "moved"), ("raw_1", "raw_0"), ("moved", "raw_1")):
        os.rename(copy / old, copy / new)
    consolidate(copy)
    assert f"/raw_0: swapped or copied: by its own record it is /{LINES[1]}" in problems(copy)
