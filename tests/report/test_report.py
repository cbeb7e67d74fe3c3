"""The report: strict HTML, nothing from outside, texts that stay texts, and what it shows of a store."""

import base64
import re
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.commands import hyperpaint
from support.refusals import expect_error, expect_refusals, expect_words
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError, StoreError
from hyperpaint.base.schema import Quality
from hyperpaint.report.summaries import page_part, plain_text

pytest.importorskip("matplotlib")

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
