"""Croissant metadata of a store: what the specification requires, hostile names, and what is refused."""

from __future__ import annotations

import fnmatch
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner

from hyperpaint.base.errors import IncompleteStoreError, PaintError, SchemaError
from hyperpaint.cli.program import main
from hyperpaint.io.store import to_store
from hyperpaint.workflows.croissant_metadata import MAX_TEXT_CHARACTERS, write_croissant

ABOUT = {
    "licence": "https://spdx.org/licenses/CC-BY-4.0.html",
    "creator": "A. Painter",
    "published": "2026-11-24",
    "version": "1.0.0",
    "url": "https://data.example.org/park",
    "cite_as": '@misc{park, title="A park"}',
}


def line(**attrs: Any) -> xr.Dataset:
    return xr.Dataset(
        {
            "radiance": (
                ("along_track", "band", "cross_track"), np.ones((4, 3, 2), np.float32),
                {"long_name": "Spectral radiance", "units": "W m-2 sr-1 nm-1"},
            ),
            "car_id": (("along_track", "cross_track"), np.zeros((4, 2), np.int32)),
            "exposure_time": ((), 0.01, {"units": "s"}),
        },
        {"time": ("along_track", np.arange(4).astype("datetime64[s]").astype("datetime64[ns]"))},
        {"scene": "tiny park, seed 2", **attrs},
    )  # fmt: skip


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path = tmp_path / "park.zarr"
    for group in ("renders/noon", "renders/cloudy"):
        to_store(line(), path, group=group)
    return path


def test_what_the_specification_requires_is_there(store: Path) -> None:
    out = store.parent / "croissant.json"
    document = write_croissant(store, out, **ABOUT)
    assert json.loads(out.read_text()) == document
    assert document["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    required = "@context @type conformsTo name description license url creator datePublished distribution"
    assert set(required.split()) <= set(document)
    first = out.read_bytes()
    write_croissant(store, out, overwrite=True, **ABOUT)
    assert out.read_bytes() == first
    files = [each for each in document["distribution"] if each["@type"] == "cr:FileObject"]
    assert [each["contentUrl"] for each in files] == [
        f"park.zarr/{group}zarr.json" for group in ("", "renders/cloudy/", "renders/noon/")
    ]
    for each in files:
        assert each["sha256"] == hashlib.sha256((out.parent / each["contentUrl"]).read_bytes()).hexdigest()
    fields = {each["@id"]: each for each in document["recordSet"][1]["field"]}
    radiance = fields["records/renders/noon/radiance"]
    assert radiance["arrayShape"] == "4,3,2"
    assert radiance["isArray"]
    assert (radiance["dataType"], radiance["unitText"]) == ("cr:Float32", "W m-2 sr-1 nm-1")
    assert radiance["description"] == "Spectral radiance (along_track, band, cross_track)"
    assert fields["records/renders/noon/car_id"]["dataType"] == "cr:Int32"
    assert fields["records/renders/noon/time"]["dataType"] == "sc:DateTime"
    assert not fields["records/renders/noon/exposure_time"]["isArray"]
    attributes = {each["name"]: each["value"] for each in document["recordSet"][0]["additionalProperty"]}
    assert attributes["scene"] == "tiny park, seed 2"


@pytest.mark.filterwarnings("ignore:.*deprecated:DeprecationWarning")  # of rdflib, within
def test_mlcommons_own_reader_has_no_objection(store: Path) -> None:
    croissant = pytest.importorskip("mlcroissant", reason="the reader of MLCommons is not installed")
    out = store.parent / "croissant.json"
    document = write_croissant(store, out, **ABOUT)
    read = croissant.Dataset(out)
    assert not read.metadata.ctx.issues.errors
    assert not read.metadata.ctx.issues.warnings
    assert [each.id for each in read.metadata.record_sets] == [each["@id"] for each in document["recordSet"]]
    radiance = next(one for one in read.metadata.record_sets[0].fields if one.name == "radiance")
    assert radiance.array_shape_tuple == (4, 3, 2)


def test_hostile_names_are_escaped(tmp_path: Path) -> None:
    store = tmp_path / 'a [b]*"é%.zarr'
    hostile = line(note='</script>\n\x00"', long="x" * (MAX_TEXT_CHARACTERS + 1)).rename(car_id="car id?#[x]")
    to_store(hostile, store, group="renders/noon")
    out = tmp_path / "croissant.json"
    write_croissant(store, out, licence="unknown", name='"}],\u2028<script>')
    text = out.read_text("ascii")
    document = json.loads(text)
    assert document["name"] == '"}],\u2028<script>'
    attributes = {each["name"]: each["value"] for each in document["recordSet"][0]["additionalProperty"]}
    assert attributes["note"] == '</script>\n\x00"'
    assert attributes["long"] == f"{MAX_TEXT_CHARACTERS + 1} characters, in the store"
    identities = [each["@id"] for each in [*document["distribution"], *document["recordSet"][0]["field"]]]
    assert len(set(identities)) == len(identities)
    assert not any(set(each) & set(' "#?[]*<>') for each in identities)
    chunks = [path.relative_to(tmp_path).as_posix() for path in store.rglob("*") if path.is_file()]
    every = document["distribution"][0]["includes"]
    assert all(fnmatch.fnmatchcase(path, every) for path in chunks)
    assert not fnmatch.fnmatchcase("a b.zarr/zarr.json", every)


def test_a_store_that_is_not_whole_is_refused(store: Path) -> None:
    out = store.parent / "croissant.json"
    chunk = next(path for path in (store / "renders/noon/radiance/c").rglob("*") if path.is_file())
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"?")
    with pytest.raises(IncompleteStoreError, match="store-incomplete"):
        write_croissant(store, out, licence="unknown")
    assert not out.exists()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"licence": " "}, "licence must be text"),
        ({"published": "yesterday"}, "must be a date"),
        ({"colour": "red"}, "colour is none of"),
    ],
)
def test_arguments_that_say_nothing_are_refused(store: Path, wrong: dict[str, str], message: str) -> None:
    with pytest.raises(SchemaError, match=message):
        write_croissant(store, store.parent / "croissant.json", **{"licence": "unknown", **wrong})


def test_only_a_new_file_beside_the_store_is_written(store: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    for out in (tmp_path / "elsewhere/croissant.json", store / "croissant.json"):
        with pytest.raises(SchemaError, match="output-outside-store"):
            write_croissant(store, out, licence="unknown")
    out = tmp_path / "croissant.json"
    out.write_text("mine")
    with pytest.raises(PaintError, match="file-exists"):
        write_croissant(store, out, licence="unknown")
    assert out.read_text() == "mine"


def test_the_command_says_what_is_lacking(store: Path) -> None:
    done = CliRunner().invoke(main, ["croissant", str(store), "--licence", "unknown"])
    assert done.exit_code == 0, done.output
    assert "croissant.json: 2 groups, 8 variables" in done.output
    assert "creator, datePublished, url" in done.output
    assert json.loads((store.parent / "croissant.json").read_text())["license"] == "unknown"
    done = CliRunner().invoke(main, ["croissant", str(store)])
    assert done.exit_code == 2
    assert "--licence" in done.output
