"""The report: strict HTML, nothing from outside, texts that stay texts, and what it shows of a store."""

import base64
import contextlib
import functools
import http.server
import json
import re
import shutil
import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_error, expect_refusals, expect_words
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import PaintWarning, SchemaError, StoreError
from hyperpaint.base.schema import Quality
from hyperpaint.io.store.computing import encode_chunk
from hyperpaint.pictures.figures import encode_png, label_for
from hyperpaint.report import write_site
from hyperpaint.report.summaries import page_part, plain_text, stored_overview

HOSTILE = (
    '</style><script>alert(1)</script><img src="http://evil.example/x" onerror=alert(2)> $\\frac{\u202e\x07'
)
VOID = {"meta", "img"}
KNOWN = {
    "html", "head", "body", "meta", "title", "style", "main", "nav", "section", "h1", "h2", "h3", "p", "a",
    "table", "tr", "th", "td", "figure", "figcaption", "img", "div", "strong", "ul", "li", "span", "details",
    "summary", "pre",
}  # fmt: skip
ATTRIBUTES = {
    "lang", "charset", "http-equiv", "content", "name", "id", "class", "href", "src", "alt", "scope", "style",
}  # fmt: skip


class Strict(HTMLParser):
    # Parses a page, and fails on anything that is not balanced, not known, or not inside the page
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.pictures: list[bytes] = []
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.words: list[str] = []
        self.style = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in KNOWN, tag
        given = dict(attrs)
        assert len(given) == len(attrs)
        assert set(given) <= ATTRIBUTES, given
        if "src" in given:
            kind, _, data = str(given["src"]).partition(",")
            assert kind == "data:image/png;base64"
            self.pictures.append(base64.b64decode(data, validate=True))
        if "href" in given:
            assert str(given["href"]).startswith("#")
            self.links.append(str(given["href"])[1:])
        if "id" in given:
            assert given["id"] not in self.ids
            self.ids.add(str(given["id"]))
        if "style" in given:
            assert re.fullmatch(r"(width:[\d.]+em|background:rgb\(\d+,\d+,\d+\))", str(given["style"]))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert tag not in VOID
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "style":
            self.style += data
        else:
            self.words.append(data)


def parsed(path: Path) -> Strict:
    # Return a page, parsed strictly
    content = path.read_text(encoding="utf-8")
    assert content.startswith("<!DOCTYPE html>")
    found = Strict()
    found.feed(content)
    found.close()
    assert not found.open
    assert not re.search(r"url\(|@import|expression", found.style)
    assert all(picture.startswith(b"\x89PNG") for picture in found.pictures)
    assert set(found.links) <= found.ids
    # no tag names anything outside, whatever texts say
    assert not re.search(r"<[^>]*(https?:|//)", re.sub(r'"data:image/png;base64,[^"]*"', '""', content))
    return found


def words(path: Path) -> str:
    return " ".join(parsed(path).words)


@pytest.fixture(scope="module")
def lot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # A store of two flight lines, one of which says hostile things, and of paints
    store = tmp_path_factory.mktemp("report") / "lot.zarr"
    line = flight(lines=40).line.paint.reflectance().compute()
    quality = np.zeros((40, 6), np.uint16)
    quality[:10, 0] = Quality.GLINT
    line["quality"] = line.quality.copy(data=quality)
    layer = xr.zeros_like(line.quality, np.float32).assign_attrs(units="1")
    layered = line.assign(glint_fraction=layer.rename("glint_fraction")).assign_attrs(collect="a car park")
    hp.to_store(layered, store, "flightlines/raw_0")
    hp.to_store(
        line.assign_attrs(name=HOSTILE, source=HOSTILE, dark_source="x" * 5000), store, "flightlines/raw_20"
    )
    hp.to_store(paints(line), store, "signatures")
    return store


def paints(line: xr.Dataset) -> xr.Dataset:
    # Return a library of two paints, one of which has a hostile name
    name = "<b onload=alert(1)>$x"
    regions = (
        hp.Region(
            "red hood",
            [(0, 0), (2, 0), (2, 9), (0, 9)],
            flightline="raw_0",
            properties={"make": "Ours & Co", "colour": "red", "age": "9"},
        ),
        hp.Region(name, [(3, 0), (5, 0), (5, 9), (3, 9)], flightline="raw_0"),
    )
    library = hp.extract_signatures({"raw_0": line}, hp.Regions(regions), exclude=0)
    window = "it is a window: <b> of"
    places = (
        ("line 7, column 3", f"{window} 4 m"),
        ("line 1, column 1", "too dark"),
        ("line 9, column 1", f"{window} 5 m"),
    )
    return library.assign_attrs(refused=[f"raw_0, {place}: {reason}" for place, reason in places])


@pytest.mark.slow
def test_a_page_of_everything(lot: Path, tmp_path: Path) -> None:
    whole, steps = tmp_path / "report.html", list[tuple[int, int]]()
    done = hp.report.write_report(lot, whole, progress=lambda *step: steps.append(step))
    lines = ("flightlines/raw_0", "flightlines/raw_20")
    assert (done.problems, done.flightlines, list(tmp_path.iterdir())) == ((), lines, [whole])
    assert (steps, steps[0], steps[-1]) == (sorted(steps), (0, 3000), (3000, 3000))
    page = parsed(whole)
    expect_words(
        " ".join(" ".join(page.words).split()),
        "True colour", "Flags", "Irradiance over time", "Reflectance", "Provenance", "a car park",
        "40 along_track x 12 band x 6 cross_track",
        "4.167 %", "95.83 % of 240 pixels have no flag.",  # of 240 pixels 10 have glint
        "red hood", "Ours & Co", "Paint by paint",
        "flags of the pixels used age colour make",  # sorted, not as the folder is listed
        "Refused regions: 3", "2 it is a window: <b> of 4 m raw_0, line 7, column 3; raw_0, line 9, column 1",
        "1 too dark raw_0, line 1, column 1",
    )  # fmt: skip
    # true colour, flags, irradiance, reflectance and its steps of two lines; the layer and two cards of one;
    # the paints and their uncertainty
    assert len(page.pictures) == 15
    assert "prefers-color-scheme: dark" in page.style
    # texts of a store stay texts
    expect_words(
        whole.read_text(encoding="utf-8"),
        "&lt;script&gt;alert(1)&lt;/script&gt;",
        "default-src 'none'",
        without=("<script", "<b ", "\u202e", "\x07", "x" * 2001),
    )


def test_how_far_figures_can_be_trusted(tmp_path: Path) -> None:
    line = flight(lines=40).line.paint.reflectance().compute()
    compared = {"alignment_state": "applied", "alignment_shift": 0.125, "alignment_shift_u": 0.003}
    hp.to_store(line.assign_attrs(compared), tmp_path / "lot.zarr", "flightlines/raw_0")
    hp.to_store(flight().line[["radiance_gain"]], tmp_path / "lot.zarr", "calibration")
    library = paints(line)
    nm = np.arange(450.0, 751.0)
    dense = np.interp(nm, line.wavelength, library.reflectance[0])
    field = xr.Dataset(
        {"reflectance": (("spectrum", "wavelength"), dense[None], {"units": "1"})},
        {"spectrum": ["red hood"], "wavelength": ("wavelength", nm, {"units": "nm"})},
        {"instrument": HOSTILE},
    )
    hp.to_store(field, tmp_path / "lot.zarr", "references/field")
    hp.to_store(library, tmp_path / "paints.zarr")
    done = hp.report.write_report(
        tmp_path / "lot.zarr", tmp_path / "r.html", library=tmp_path / "paints.zarr", cards=0
    )
    assert done.problems == ()
    expect_words(
        " ".join(words(tmp_path / "r.html").split()),
        "camera minus record, at 600 nm [nm] 0.125 \u00b1 0.003",
        "1 of 1 pair within tolerance",
        "without a reference: <b onload=alert(1)>$x",
        "Uncertainty", "Gain, width and smile", "From counts to reflectance", "validation",
        without=("There is no map",),
    )  # fmt: skip
    expect_words((tmp_path / "r.html").read_text(encoding="utf-8"), without=("<script",))


def test_texts_are_escaped_and_cut() -> None:
    parts = page_part("heading", text="<&\"'>"), page_part("paragraph", text="<i>", kind='"x')
    assert list(map(str, parts)) == [
        "<h3>&lt;&amp;&#34;&#39;&gt;</h3>",
        '<p class="&#34;x">&lt;i&gt;</p>',
    ]
    assert plain_text(parts[0]) is parts[0]
    cleaned = [str(plain_text(text)) for text in ("a\x00\x1b[31m\ud800b\nc", "x" * 9999)]
    assert cleaned == ["a\ufffd\ufffd[31m\ufffdb\nc", "x" * 2000 + "..."]


def test_one_line_alone_and_what_is_refused(lot: Path, tmp_path: Path) -> None:
    write, page = hp.report.write_report, tmp_path / "one.html"
    page.write_text("mine")
    alone = hp.to_store(flight().line, tmp_path / "line.zarr")
    none = tmp_path / "none.html"
    expect_refusals(
        (StoreError, "file-exists", "overwrite=True", lambda: write(lot, page)),
        (SchemaError, "flightline-unknown", "'raw_1'", lambda: write(lot, none, flightlines=["raw_1"])),
        (SchemaError, "value-out-of-range", "cards=-1", lambda: write(lot, none, cards=-1)),
        (SchemaError, "value-out-of-range", "lines=0", lambda: write(lot, none, max_lines=0)),
        (SchemaError, "library-missing", lambda: write(lot, none, library=alone)),
        (StoreError, "path-inside-store", lambda: write(lot, lot / "report.html")),
        (StoreError, "path-is-folder", lambda: write(lot, tmp_path)),
        (StoreError, "folder-missing", lambda: write(lot, tmp_path / "no" / "report.html")),
    )
    assert (page.read_text(), none.exists()) == ("mine", False)
    assert write(lot, page, flightlines=["raw_20"], max_lines=5, cards=1, overwrite=True).flightlines == (
        "flightlines/raw_20",
    )
    parsed(page)


def test_what_is_missing_is_left_out(tmp_path: Path) -> None:
    line = flight(lines=16).line
    radiance = line.paint.radiance().compute()[["radiance", "quality"]].assign_attrs(line.attrs)
    hp.to_store(radiance, tmp_path / "a.zarr", "flightlines/raw_0")
    assert hp.report.write_report(tmp_path / "a.zarr", tmp_path / "a.html").problems == ()
    assert "There is no picture" not in words(tmp_path / "a.html")  # that of radiance is shown
    empty = tmp_path / "c.zarr"
    hp.to_store(xr.Dataset({"a": ("x", np.arange(3.0))}), empty, "other")
    expect_error(StoreError, "store-empty", lambda: hp.report.write_report(empty, tmp_path / "c.html"))


def test_damage_is_named_and_the_rest_is_shown(lot: Path, tmp_path: Path) -> None:
    spoiled, page = tmp_path / "lot.zarr", tmp_path / "r.html"
    shutil.copytree(lot, spoiled)
    (spoiled / "flightlines/raw_0/reflectance/c/0/0/0").unlink()
    options = ("--line", "raw_0", "--cards", 0, "--quiet")
    run = hyperpaint("report", spoiled, "--out", page, *options, status=1)
    assert "cannot be read: /flightlines/raw_0" in run.stderr
    expect_words(words(page), "Irradiance over time", "red hood")


@pytest.mark.slow
def test_the_command_with_a_library_beside_the_store(lot: Path, tmp_path: Path) -> None:
    page, library = tmp_path / "r.html", tmp_path / "paints.zarr"
    hp.to_store(paints(hp.open_store(lot, "flightlines/raw_0")), library)
    page.write_text("mine")
    call = ("report", lot, "--out", page, "--line", "raw_0", "--library", library, "--cards", 0)
    assert "pass --overwrite" in hyperpaint(*call, status=2).stderr
    run = hyperpaint(*call, "--overwrite", status=0)
    assert ("1 flight line (raw_0)" in run.stdout, run.stderr) == (True, "")
    assert "paints.zarr" in words(page)
    hyperpaint("report", tmp_path / "nothing.zarr", "--out", tmp_path / "x.html", status=2)


def texts(dims: str, shape: tuple[int, ...]) -> tuple[tuple[str, ...], np.ndarray]:
    return tuple(dims.split()), np.full(shape, "{}")


#: Group, change of its content, and words of the problem that the page names.
ODD: list[tuple[str, Callable[[xr.Dataset], xr.Dataset], str]] = [
    (
        "signatures",
        lambda library: library.assign(n=("signature", ["many", "few"], {"units": "1"})),
        "'n' is",
    ),
    (
        "signatures",
        lambda library: library.assign(quality=("signature", [np.nan, 1.0])),
        "'quality' is float",
    ),
    ("signatures", lambda library: library.assign(n_eff=library["reflectance"].variable), "'n_eff'"),
    (
        "signatures",
        lambda library: library.assign_coords(
            quantile=("quantile", [f"q{level}" for level in library["quantile"].values], {"units": "1"})
        ),
        "'quantile' is",
    ),
    (
        "signatures",
        lambda library: library.assign(sun_zenith=("signature", ["high", "low"], {"units": "radian"})),
        "'sun_zenith' is",
    ),
    (
        "signatures",
        lambda library: library.drop_vars("region").assign(region=texts("band signature", (12, 2))),
        "regions",
    ),
    (
        "flightlines/raw",
        lambda line: line.assign(quality=line["quality"].astype(np.float32)),
        "quality is float32",
    ),
    ("flightlines/raw", lambda line: line.isel(along_track=slice(0, 0)), "no pixels"),
    ("flightlines/raw", lambda line: line.isel(irradiance_time=slice(0, 0)), "irradiance_time"),
    ("flightlines/raw", lambda line: line.drop_vars("irradiance_time"), "irradiance_time"),
    (
        "flightlines/raw",
        lambda line: line.assign(glint_fraction=texts("along_track cross_track", (40, 6))),
        "glint_fraction",
    ),
]


@pytest.mark.slow
def test_odd_contents_are_named_and_the_rest_is_shown(lot: Path, tmp_path: Path) -> None:
    # `to_store` takes any dataset, also one that no step of ours has made: the page is there, names all that
    # is wrong, and shows what comes after it; exit status 1
    kinds = {"flightlines/raw": "flightlines/raw_0", "signatures": "signatures"}
    contents = {kind: hp.open_store(lot, name).load() for kind, name in kinds.items()}
    odd = [(f"{kind}_{number}", kind, spoil, named) for number, (kind, spoil, named) in enumerate(ODD, 1)]
    for group, kind, spoil, _ in (
        *odd,
        *((name, kind, lambda same: same, "") for kind, name in kinds.items()),
    ):
        hp.to_store(spoil(contents[kind]).drop_encoding(), tmp_path / "odd.zarr", group)
    options = ("--cards", 2, "--quiet")
    run = hyperpaint("report", tmp_path / "odd.zarr", "--out", tmp_path / "r.html", *options, status=1)
    page = parsed(tmp_path / "r.html")
    shown = " ".join(page.words)
    for group, _, _, named in odd:
        assert re.search(f"(?m)^cannot be read: /{group}, .*{named}", run.stderr), run.stderr
    expect_words(shown, "red hood", *(named for *_, named in odd))
    assert shown.count("Provenance") == len(ODD) + 2
    # of the paints, at least the spectra; of the line, whatever has nothing to do with what is wrong
    assert len(page.pictures) >= 3 * len(ODD)


def test_a_zipped_store_is_shown(tmp_path: Path) -> None:
    hp.to_store(flight(lines=16).line, tmp_path / "lot.zarr", "flightlines/raw_0")
    packed = shutil.make_archive(str(tmp_path / "lot"), "zip", tmp_path / "lot.zarr")
    report = hp.report.write_report(packed, tmp_path / "r.html", flags=False, cards=0)
    assert (report.flightlines, report.problems) == (("flightlines/raw_0",), ())


# --- The page for web servers: what it copies, what it refuses, and what a browser reads ---


CHROMIUM = Path("/usr/bin/chromium")
HOSTILE_NAME = "<img src=x onerror=alert(1)>\"'</script>"
# on column 2 and line 8 (the line begins at 5)
HOOD = hp.Region("red hood", [(2, 8), (6, 8), (6, 14)], flightline="raw_0")
DIMS = ("along_track", "band", "cross_track")


def cube(lines: int = 70, bands: int = 24, columns: int = 40, first: int = 5) -> xr.Dataset:
    # A line of three tiles a side and more, with smile, flags, a bad band, samples without a value
    values = np.random.default_rng(1).uniform(-0.02, 1.4, (lines, bands, columns)).astype(np.float32)
    values[3, :, 7] = np.nan
    values[4, 20:, 2] = [np.nan, np.inf, 1e-42, -0.0]
    flags = np.zeros((lines, columns), np.uint16)
    flags[:10, 5:20] = Quality.GLINT
    flags[5:30, 10:12] |= np.uint16(Quality.SHADOW)
    good = np.arange(bands) != 3
    return xr.Dataset(
        {"reflectance": (DIMS, values, {"units": "1"}), "quality": (("along_track", "cross_track"), flags)},
        {
            "wavelength": ("band", np.linspace(400.0, 950.0, bands), {"units": "nm"}),
            "wavelength_shift": ("cross_track", np.linspace(-0.5, 0.5, columns), {"units": "nm"}),
            "good": ("band", good),
            "along_track": np.arange(first, first + lines),
            "cross_track": np.arange(columns),
        },
        {"collect": HOSTILE_NAME},
    )


def site_paints(line: xr.Dataset) -> xr.Dataset:
    values = line["reflectance"].values[40:43, :, 0] * np.float32(0.5)
    return xr.Dataset(
        {
            "reflectance": (("signature", "band"), values, {"units": "1"}),
            "reflectance_sd": (("signature", "band"), 0.1 * values, {"units": "1"}),
            "member_reflectance": (("signature", "member", "band"), values[:, None], {"units": "1"}),
            "n": ("signature", np.array([4, 5, 6]), {"units": "1"}),
        },
        {
            "signature": ["red hood", HOSTILE_NAME, "Lack, grün"],
            "wavelength": line["wavelength"],
            "good": line["good"],
            "region": ("signature", [json.dumps(HOOD.feature()), "no region", ""]),
            "flightline": ("signature", ["raw_0", "raw_0", ""]),
        },
    )


@pytest.fixture(scope="module")
def site_lot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = tmp_path_factory.mktemp("site") / "lot.zarr"
    hp.to_store(cube(), store, "flightlines/raw_0")
    hp.to_store(cube(lines=20, first=0), store, "flightlines/raw #1 % <b>")
    hp.to_store(site_paints(cube()), store, "signatures")
    return store


@pytest.fixture(scope="module")
def page(site_lot: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    done = write_site(site_lot, tmp_path_factory.mktemp("served") / "page", flags=False)
    assert (done.problems, set(done.flightlines)) == ((), {"flightlines/raw_0", "flightlines/raw #1 % <b>"})
    return done.path


def test_the_copy_is_a_store_of_small_tiles_with_the_same_bits(site_lot: Path, page: Path) -> None:
    copy = page / "store.zarr"
    assert hp.verify(copy).ok
    for group in ("flightlines/raw_0", "flightlines/raw #1 % <b>"):
        mine, theirs = hp.open_store(site_lot, group), hp.open_store(copy, group)
        for name in ("reflectance", "quality", "wavelength", "wavelength_shift", "good", "along_track"):
            assert (mine[name].values.tobytes(), mine[name].attrs) == (
                theirs[name].values.tobytes(),
                theirs[name].attrs,
            )
    plain = xr.open_zarr(copy, group="flightlines/raw_0")
    assert (
        plain.reflectance.data.chunksize,
        plain.quality.data.chunksize,
        hp.open_store(copy, "flightlines/raw_0").reflectance.data.numblocks,
    ) == ((16, 24, 16), (70, 40), (5, 1, 1))
    library = hp.open_store(copy, "signatures")
    assert "member_reflectance" not in library
    assert library.reflectance.values.tobytes() == site_paints(cube()).reflectance.values.tobytes()


def test_the_folder_holds_all_and_names_nothing_outside(page: Path) -> None:
    names = {file.name for file in page.iterdir()}
    own = {"index.html", "site.css", "site.js", "chart.js", "codecs.js", "zarrita.min.js"}
    assert names == own | {"site.json", "pictures", "store.zarr"}
    expect_words(
        (page / "index.html").read_text(),
        "default-src 'none'; script-src 'self'; style-src 'self';",
        without=("unsafe", "%ORIGIN%"),
    )
    for file in own:
        text = (page / file).read_text()
        code = text.partition("*/")[2] if text.startswith("/*!") else text
        assert not any(word in code for word in ("eval(", "new Function", "innerHTML", "document.write")), (
            file
        )
        places = code.replace("http://www.w3.org/2000/svg", "")
        assert "//cdn" not in places
        assert "https://" not in places or file == "zarrita.min.js", file
    assert "MIT License" in (page / "zarrita.min.js").read_text()
    assert (page / "zarrita.min.js").stat().st_size < 150_000
    index = json.loads((page / "site.json").read_text())
    assert (index["title"], [entry["first"] for entry in index["lines"]]) == (HOSTILE_NAME, [[0, 0], [5, 0]])
    assert all((page / entry["picture"]).read_bytes().startswith(b"\x89PNG") for entry in index["lines"])


def test_reflectance_is_computed_where_the_store_has_counts_alone(tmp_path: Path) -> None:
    hp.to_store(flight(lines=40, position=True).line, tmp_path / "raw.zarr", "flightlines/raw_0")
    with pytest.warns(PaintWarning, match="contradicts every sky"):
        done = write_site(tmp_path / "raw.zarr", tmp_path / "page")
    expected = hp.open_store(tmp_path / "raw.zarr", "flightlines/raw_0").paint.reflectance(keep_bits=12)
    copy = hp.open_store(done.path / "store.zarr", "flightlines/raw_0")
    assert copy.reflectance.values.tobytes() == expected.reflectance.values.tobytes()
    assert "counts" not in copy
    assert "flags_from" in copy.quality.attrs  # looked for on the way
    expect_error(
        StoreError,
        r"missing.*store-empty",
        lambda: write_site(tmp_path / "raw.zarr", tmp_path / "linked", link="../raw.zarr"),
    )


def grid(line: xr.Dataset) -> xr.Dataset:
    # Return a map with the values of a line
    values = line.reflectance.values.transpose(0, 2, 1)
    return xr.Dataset(
        {"reflectance": (("y", "x", "band"), values, {"units": "1"})},
        {"wavelength": line["wavelength"], "y": np.arange(70.0)[::-1], "x": np.arange(40.0)},
    )


def test_maps_and_a_library_beside_the_store(tmp_path: Path) -> None:
    line = cube()
    orthomap = grid(line)
    hp.to_store(orthomap, tmp_path / "map.zarr")
    hp.to_store(site_paints(line), tmp_path / "paints.zarr")
    done = write_site(tmp_path / "map.zarr", tmp_path / "page", library=tmp_path / "paints.zarr")
    assert (done.problems, done.flightlines, done.maps) == ((), (), ("map.zarr",))
    copy = xr.open_zarr(tmp_path / "page" / "store.zarr", group="map")
    assert (copy.reflectance.data.chunksize, copy.reflectance.values.tobytes()) == (
        (16, 16, 24),
        orthomap.reflectance.values.tobytes(),
    )
    index = json.loads((tmp_path / "page" / "site.json").read_text())
    assert ((index["lines"][0]["name"], index["lines"][0]["lies"]), index["libraries"][0]["group"]) == (
        ("map.zarr", False),
        "library",
    )
    expect_error(
        SchemaError,
        "option-conflict",
        lambda: write_site(
            tmp_path / "map.zarr", tmp_path / "b", library=tmp_path / "paints.zarr", link="../a"
        ),
    )


@pytest.mark.parametrize(
    ("link", "origin"),
    [("https://data.example.org:8443/a b.zarr", "https://data.example.org:8443"), ("../lot.zarr", "")],
)
def test_a_linked_store_is_not_copied(site_lot: Path, tmp_path: Path, link: str, origin: str) -> None:
    write_site(site_lot, tmp_path / "page", link=link)
    assert not (tmp_path / "page" / "store.zarr").exists()
    assert f"connect-src 'self' {origin};" in (tmp_path / "page" / "index.html").read_text()
    assert json.loads((tmp_path / "page" / "site.json").read_text())["store"] == link


@pytest.mark.parametrize(
    "link",
    [
        "javascript:alert(1)",
        "https://a.example;script-src *",
        "file:///etc",
        "",
        "https://u:p@host/x",
        "//h/x",
    ],
)
def test_what_is_no_address_is_refused(site_lot: Path, tmp_path: Path, link: str) -> None:
    expect_error(SchemaError, "link-invalid", lambda: write_site(site_lot, tmp_path / "page", link=link))
    assert not (tmp_path / "page").exists()


def test_only_a_site_is_replaced_and_only_when_asked(site_lot: Path, tmp_path: Path) -> None:
    call = partial(hyperpaint, "site", site_lot, "--no-flags", "--line", "raw_0", "--quiet")
    assert call("--out", tmp_path / "page", status=0).stdout.startswith(f"{tmp_path / 'page'}: raw_0, ")
    assert "pass --overwrite" in call("--out", tmp_path / "page", status=2).stderr
    assert call("--out", tmp_path / "page", "--overwrite").exit_code == 0
    (tmp_path / "page" / ".git").mkdir()
    assert ".git, which is not part of a site" in call("--out", tmp_path / "page", "--overwrite").stderr
    assert (tmp_path / "page" / ".git").is_dir()
    assert call("--out", site_lot / "page").exit_code == 2
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "site.json").write_text("{}")
    assert "holds other files" in call("--out", tmp_path / "mine", "--overwrite").stderr
    expect_error(
        SchemaError, r"lines=0.*out-of-range", lambda: write_site(site_lot, tmp_path / "new", max_lines=0)
    )


# --- in a browser ------------------------------------------------------------------------------------------


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api")
    if not CHROMIUM.exists():
        pytest.skip(f"no browser at {CHROMIUM}")
    with api.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield chromium
        chromium.close()


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[str]:
    # Serve a folder as `python -m http.server` does; yield its address
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def served(page: Path) -> Iterator[str]:
    with serving(page) as address:
        yield address


@pytest.fixture
def tab(browser: Any) -> Iterator[Any]:
    # A page of the browser, in which no script fails and nothing is refused by the policy
    context = browser.new_context(viewport={"width": 1000, "height": 700})
    context.complaints = []
    shown = context.new_page()
    shown.on("console", lambda message: context.complaints.append(message.text))
    shown.on("pageerror", lambda error: context.complaints.append(str(error)))
    shown.on("dialog", lambda dialog: context.complaints.append(dialog.message))
    yield shown
    complaints = context.complaints
    context.close()
    assert complaints == []


def visit(tab: Any, address: str) -> None:
    tab.goto("about:blank")
    tab.goto(address)
    tab.wait_for_selector("#stage[data-ready]", state="attached")


READ = """async ([name, x, y]) => {
  const {spectrum} = await import("./site.js");
  const {nm, values, good, quality} = await spectrum(name, x, y);
  const bits = new Uint32Array(values.buffer.slice(values.byteOffset, values.byteOffset + values.byteLength));
  return {kind: values.constructor.name, nm, bits: [...bits], good, quality};
}"""


@pytest.mark.slow
def test_a_click_reads_what_python_reads_bit_for_bit(tab: Any, served: str, page: Path) -> None:
    visit(tab, served)
    rng = np.random.default_rng(2)
    for name in ("raw_0", "raw #1 % <b>"):
        line = hp.open_store(page / "store.zarr", f"flightlines/{name}").load()
        places = [(3, 8), (2, 9)] if name == "raw_0" else []
        xs, ys = rng.choice(line.cross_track, 12), rng.choice(line.along_track, 12)
        for x, y in [*places, *zip(xs.tolist(), ys.tolist(), strict=True)]:
            expected = line.sel(along_track=y, cross_track=x)
            read = tab.evaluate(READ, [name, x, y])
            assert (read["kind"], read["bits"]) == (
                "Float32Array",
                expected.reflectance.values.view(np.uint32).tolist(),
            )
            assert (read["nm"], read["good"], read["quality"]) == (
                (expected.wavelength + expected.wavelength_shift).values.tolist(),
                expected.good.values.astype(int).tolist(),
                int(expected.quality),
            )


@pytest.mark.slow
@pytest.mark.parametrize("link", [None, "../map.zarr"])
def test_a_map_copied_or_where_it_is(tab: Any, tmp_path: Path, link: str | None) -> None:
    hp.to_store(grid(cube()), tmp_path / "map.zarr")
    write_site(tmp_path / "map.zarr", tmp_path / "page", link=link)
    with serving(tmp_path) as address:
        visit(tab, f"{address}page/#x=33&y=66")
        assert tab.inner_text("#place") == "column 33, row 66"
        box = tab.locator("#stage").bounding_box()  # north up: columns run along x
        tab.mouse.click(box["x"] + 8.5 / 40 * box["width"], box["y"] + 2.5 / 70 * box["height"])
        assert tab.inner_text("#place") == "column 8, row 2"
        assert (tab.evaluate(READ, ["map.zarr", 8, 2])["bits"], tab.inner_text("#flagged")) == (
            cube().reflectance.values[2, :, 8].view(np.uint32).tolist(),
            "There are no flags here.",
        )


@pytest.mark.slow
def test_paints_are_outlined_and_drawn_in_their_colours(tab: Any, served: str, page: Path) -> None:
    visit(tab, served + "#line=raw_0&x=8&y=12&paint=red%20hood")
    colour = json.loads((page / "site.json").read_text("utf-8"))["libraries"][0]["colours"][0]
    assert tab.locator("#outlines g.ticked").count() == tab.locator("#outlines g").count() == 1
    # corners are pixel centres, lines run to the right
    assert tab.locator("#outlines .own").get_attribute("points").split()[0] == "3.5,2.5"
    assert tab.evaluate(
        "[...document.querySelectorAll('#chart .curve')].map(one => one.style.getPropertyValue('--own'))"
    ) == ["", colour]
    tab.uncheck("#outlining")
    assert tab.locator("#outlines g").count() == 0


@pytest.mark.slow
def test_click_keys_flags_and_address(tab: Any, served: str, page: Path) -> None:
    visit(tab, served + "#line=raw_0")
    assert (tab.title(), tab.inner_text("#flagged")) == (HOSTILE_NAME, "No pixel is chosen yet.")
    box = tab.locator("#stage").bounding_box()
    column, line = 12, 8  # flown to the right: lines run along x
    scale = box["width"] / 70
    tab.mouse.click(box["x"] + (line - 5 + 0.5) * scale, box["y"] + (column + 0.5) * scale)
    tab.wait_for_selector("#chart svg")
    assert (tab.inner_text("#place"), tab.inner_text("#flagged")) == ("line 8, column 12", "Flags: glint")
    assert "kB read in" in tab.inner_text("#status")
    assert "x=8&y=12" in tab.url
    tab.focus("#stage")
    for key in ("ArrowRight", "ArrowRight", "Shift+ArrowDown", "ArrowUp"):
        tab.keyboard.press(key)
    assert tab.inner_text("#place") == "line 10, column 21"
    tab.click("#keep")
    tab.keyboard.press("ArrowLeft")
    tab.check("#flags")
    tab.wait_for_selector("#legend li")
    assert sorted(tab.locator("#legend li").all_inner_texts()) == [" glint, 5.4 %", " shadow, 1.8 %"]
    counted = """() => {
      const layer = document.getElementById("layer");
      const context = layer.getContext("2d", {willReadFrequently: true});
      const {data} = context.getImageData(0, 0, layer.width, layer.height);
      return data.filter((_, k) => k % 4 === 3 && data[k]).length;
    }"""
    assert tab.evaluate(counted) == 150 + 50 - 10
    tab.get_by_text("shadow").click()
    assert tab.evaluate(counted) == 150
    # what the address says is shown again
    visit(tab, tab.url)
    assert tab.is_checked("#flags")
    assert (tab.locator("#curves li").count(), tab.inner_text("#place")) == (2, "line 10, column 21")
    # a spectrum as a table has every digit
    with tab.expect_download() as download:
        tab.click("#csv")
    rows = Path(download.value.path()).read_text(encoding="utf-8").splitlines()
    values = [float(row.split(",")[1]) for row in rows[1:]]
    line_ = hp.open_store(page / "store.zarr", "flightlines/raw_0")
    np.testing.assert_array_equal(values, line_.reflectance.sel(along_track=10, cross_track=21).values)


@pytest.mark.slow
def test_names_stay_texts_and_paints_stand_beside(tab: Any, served: str) -> None:
    visit(tab, served + "#line=raw%20%231%20%25%20%3Cb%3E&x=2&y=3&paint=red%20hood")
    assert tab.locator("#curves li").all_inner_texts() == ["raw #1 % <b>, line 2, column 3", "red hood"]
    assert tab.locator("#paints .name").all_inner_texts() == ["red hood", HOSTILE_NAME, "Lack, grün"]
    tab.get_by_text(HOSTILE_NAME).last.click()
    tab.wait_for_function("document.querySelectorAll('#curves li').length === 3")
    assert (tab.locator("#chart .spread").count(), tab.locator("img").count()) == (2, 1)
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
    for address in (
        "#line=<img src=x onerror=alert(1)>&x=1e9&y=%00&keep=1,2,x&paint=no&zoom=-4",
        "#x=2&y=999&line=raw_0",
    ):
        visit(tab, served + address)
    assert "has no pixel 999, 2" in tab.inner_text("#status")
    tab.set_viewport_size({"width": 400, "height": 800})
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.slow
def test_damage_and_gaps_are_said_and_never_shown_as_values(
    tab: Any, served: str, page: Path, request: pytest.FixtureRequest
) -> None:
    chunk = page / "store.zarr/flightlines/raw_0/reflectance/c/2/0/1"
    whole = chunk.read_bytes()
    request.addfinalizer(lambda: chunk.write_bytes(whole))
    visit(tab, served + "#line=raw_0")
    damaged = bytearray(whole)
    damaged[-9] ^= 4
    for content, said in ((bytes(damaged), "checksum"), (whole[:-7], "checksum"), (None, "is missing")):
        chunk.unlink() if content is None else chunk.write_bytes(content)
        visit(tab, served + "#line=raw_0&x=45&y=20")
        assert said in tab.inner_text("#status")
        assert tab.locator("#chart svg").count() == 0
    complaints = tab.context.complaints
    assert all("404" in text for text in complaints)
    complaints.clear()


@pytest.mark.slow
def test_frames_of_our_stores_are_decoded(tab: Any, served: str) -> None:
    visit(tab, served)
    rng = np.random.default_rng(3)
    smooth = np.cumsum(rng.normal(size=70_000)).astype(np.float32)
    cases = [
        smooth,
        np.round(smooth, 1),
        np.frombuffer(rng.bytes(40_000), np.uint8),
        np.zeros(9, np.uint8),
        np.arange(1001, dtype=np.int64),
        rng.integers(0, 4000, 5003).astype(np.uint16),
        rng.uniform(size=777) > 0.5,
        np.float64([1.5]),
        np.repeat(rng.integers(0, 9, 300), 1000).astype(np.int32),
        np.array([], np.float32),
    ]
    decode = """async (frame) => {
      const {unblosc, checked} = await import("./codecs.js");
      const bytes = unblosc(checked(Uint8Array.from(atob(frame), (sign) => sign.charCodeAt(0))));
      return btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
    }"""
    for values in cases:
        for codec in ("compact", "fast"):
            frame = b"".join(encode_chunk(values, values.shape, None, codec))
            decoded = base64.b64decode(tab.evaluate(decode, base64.b64encode(frame).decode()))
            assert decoded == values.tobytes(), (values.dtype, codec)
    # whatever a frame says, it is decoded or refused
    tried = """async (frames) => {
      const {unblosc} = await import("./codecs.js");
      return frames.map((frame) => {
        const bytes = Uint8Array.from(atob(frame), (sign) => sign.charCodeAt(0));
        try { return unblosc(bytes).length; } catch { return -1; }
      });
    }"""
    frame = encode_chunk(smooth[:4000], (4000,), None, "compact")[0]
    spoiled = [bytearray(frame) for _ in range(300)]
    for each in spoiled:
        each[int(rng.integers(0, len(each) if rng.uniform() < 0.5 else 60))] = int(rng.integers(256))
    sizes = tab.evaluate(tried, [base64.b64encode(each).decode() for each in spoiled])
    assert max(sizes) < 2**30
    expect_words(sizes, -1, 16_000)


# --- What a dataset says of itself in a notebook: nothing computed, nothing believed


def with_overview(line: xr.Dataset) -> xr.Dataset:
    picture = np.arange(24 * 6 * 3, dtype=np.uint8).reshape(24, 6, 3)
    attrs = {"line_step": 1, "column_step": 1}
    return line.assign(overview=(("overview_y", "overview_x", "rgb"), picture, attrs))


def test_a_flight_line_and_a_library_in_words() -> None:
    shown = repr(flight().line.paint)
    assert shown.startswith("flight line raw_0\n")
    expect_words(
        shown,
        "24 along_track x 12 band x 6 cross_track, float32 [count]",
        "500 to 700 nm, fwhm 6 nm",
        "2020-06-21T17:00:10.000 to 2020-06-21T17:00:10.161 UTC",
        ".reflectance()",
    )
    region = hp.Region("hood", [(0, 0), (2, 0), (2, 9), (0, 9)])
    library = repr(hp.extract_signatures(flight().line, hp.Regions((region,)), exclude=0).paint)
    assert library.startswith("paint library")
    expect_words(library, "1 paint: hood", "30 to 30 a paint")


def test_flags_are_told_where_they_are_at_hand() -> None:
    line = flight().line
    quality = np.zeros((24, 6), np.uint16)
    quality[:6] = Quality.GLINT
    known = line.assign(quality=(("along_track", "cross_track"), quality))
    assert "glint 25 %" in repr(known.paint)
    assert "not computed yet" in repr(known.chunk(along_track=8).paint)
    assert "no flag set" in repr(known.assign(quality=known.quality * np.uint16(0)).paint)


def test_nothing_is_computed(no_compute: Any) -> None:
    # small variables as they are, cubes lazy
    whole = with_overview(flight().line)
    line = whole.chunk(along_track=8).assign_coords(whole.coords)
    line = line.assign(
        {name: whole[name] for name in whole.data_vars if "along_track" not in whole[name].dims}
    ).paint.reflectance()
    line["overview"] = line.overview.chunk(overview_y=8)
    with no_compute():
        shown = line.paint._repr_html_()
    assert "not computed yet" in shown
    # a picture that would have to be computed is not
    assert "<img" not in shown


def test_the_stored_picture_is_shown(tmp_path: Path) -> None:
    hp.to_store(with_overview(flight().line), tmp_path / "lot.zarr", "flightlines/raw_0")
    line = xr.open_zarr(tmp_path / "lot.zarr", group="flightlines/raw_0")
    found = re.search(r'src="data:image/png;base64,([^"]+)"', line.paint.reflectance().paint._repr_html_())
    assert found
    # along_track to the right
    assert struct.unpack(">II", base64.b64decode(found[1])[16:24]) == (24, 6)
    np.testing.assert_array_equal(stored_overview(line), with_overview(flight().line).overview)


def test_a_store_that_is_gone_is_no_error(tmp_path: Path) -> None:
    hp.to_store(with_overview(flight().line), tmp_path / "lot.zarr")
    line = xr.open_zarr(tmp_path / "lot.zarr")
    shutil.rmtree(tmp_path / "lot.zarr")
    assert "flight line" in repr(line.paint)
    assert "flight line" in line.paint._repr_html_()


@pytest.mark.parametrize(
    "odd",
    [
        xr.Dataset(),
        xr.Dataset({"a": 1}),
        xr.Dataset({"reflectance": ("signature", [1.0])}),
        xr.Dataset({"counts": ("along_track", ["x"])}, {"wavelength": ("band", ["red"]), "time": 3}),
        xr.Dataset({"overview": (("overview_y", "overview_x", "rgb"), np.zeros((0, 3, 3), "u1"))}),
    ],
)
def test_any_dataset_has_a_summary(odd: xr.Dataset) -> None:
    assert repr(odd.paint)
    HTMLParser().feed(odd.paint._repr_html_())


def test_names_and_attributes_stay_texts() -> None:
    line = flight().line.assign_attrs(name="<script>\x1b[31m", dark_source="<img src=x>")
    expect_words(
        line.paint._repr_html_(),
        "&lt;script&gt;",
        without=("<script", "<img"),
    )
    assert "\x1b" not in repr(line.paint)


def test_png_holds_the_picture() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    made = encode_png(picture)
    kinds, at = {}, 8
    while at < len(made):
        (size,) = struct.unpack(">I", made[at : at + 4])
        kind, data = made[at + 4 : at + 8], made[at + 8 : at + 8 + size]
        assert struct.unpack(">I", made[at + 8 + size : at + 12 + size])[0] == zlib.crc32(kind + data)
        kinds[kind] = data
        at += 12 + size
    rows = np.frombuffer(zlib.decompress(kinds[b"IDAT"]), np.uint8).reshape(5, 22)
    assert not rows[:, 0].any()
    np.testing.assert_array_equal(rows[:, 1:].reshape(5, 7, 3), picture)


def test_labels_are_letters() -> None:
    assert (
        label_for("$\\frac{1}$"),
        label_for("_hidden"),
        label_for("a\nb\x00"),
        len(label_for("x" * 500)),
    ) == (r"\$\frac{1}\$", " _hidden", "a\ufffdb\ufffd", 60)


def test_a_library_shows_the_colours_of_its_paints() -> None:
    nm = np.arange(400.0, 701.0, 10.0)
    spectra = [np.where(nm > 600, 0.8, 0.03), np.full(nm.size, 0.9), np.full(nm.size, np.nan)]
    library = xr.Dataset(
        {
            "reflectance": (("signature", "band"), np.float32(spectra), {"units": "1"}),
            "n": ("signature", [120, 7, 0], {"units": "1"}),
        },
        {"signature": ["red", "<b>white</b>", "none"], "wavelength": ("band", nm, {"units": "nm"})},
    )
    shown = library.paint._repr_html_()
    colours = re.findall(r"background:(#[0-9a-f]{6})", shown)
    red, white = (np.frombuffer(bytes.fromhex(colour[1:]), np.uint8).astype(int) for colour in colours)
    assert red[0] > 200
    assert red[1:].max() < 100
    # level spectra are grey: 0.9 is 243 in sRGB
    assert np.abs(white - 243).max() <= 2
    assert shown.count('role="img"') == 3
    expect_words(shown, "n = 120", "&lt;b&gt;white", without=("<b>",))
    # at home on a page of either theme
    assert "currentColor" in shown
    assert "color:" not in shown.replace("border-color:", "")
    with_quantities = library.assign(reflectance=library.reflectance * 100)
    with_quantities["reflectance"].attrs["units"] = "percent"
    assert re.findall(r"background:(#[0-9a-f]{6})", with_quantities.paint._repr_html_()) == colours


def test_colours_are_not_computed(no_compute: Any) -> None:
    nm = np.arange(400.0, 701.0, 10.0)
    library = xr.Dataset(
        {"reflectance": (("signature", "band"), np.full((2, nm.size), 0.5, "f4"), {"units": "1"})},
        {"signature": ["a", "b"], "wavelength": ("band", nm, {"units": "nm"})},
    )
    lazy = library.assign(reflectance=library.reflectance.chunk(signature=1))
    with no_compute():
        assert 'role="img"' not in lazy.paint._repr_html_()
