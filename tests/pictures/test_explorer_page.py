"""``hyperpaint view`` in Chromium: click, drag, slide, draw, mend, save."""

import contextlib
import http.client
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from click.testing import CliRunner
from support.refusals import expect_error
from support.strategies import flight

import hyperpaint as hp
from hyperpaint.cli.program import main
from hyperpaint.pictures import exploring

pytestmark = pytest.mark.slow

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

PLACE_OF = """([along, across]) => {
  const plot = Bokeh.documents[0].get_model_by_name("picture");
  const view = Bokeh.index.find_one_by_id(plot.id);
  const {left, top} = view.el.getBoundingClientRect();
  return [left + view.frame.x_scale.compute(along), top + view.frame.y_scale.compute(across)];
}"""
CURVES = """() => {
  const plot = Bokeh.documents[0].get_model_by_name("spectra");
  const {data} = plot.renderers.find(one => one.glyph.type == "MultiLine").data_source;
  return data.name.map((name, place) => [name, Array.from(data.reflectance[place])]);
}"""


class Served(NamedTuple):
    # A page that is served
    address: str
    folder: Path
    process: subprocess.Popen[str]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    # A store of two lines of 24 x 6 pixels, with some shadow, served from its folder
    pytest.importorskip("panel")
    folder = tmp_path_factory.mktemp("served")
    line = flight().line.paint.reflectance()[["counts", *flight().line.data_vars, "quality"]].compute()
    quality = line["quality"].values.copy()
    quality[10:, :2] |= np.uint16(hp.Quality.SHADOW)
    line["quality"] = line["quality"].copy(data=quality)
    for name in ("raw_0", "raw_1"):
        hp.to_store(line, folder / "lot.zarr", f"flightlines/{name}")
    command = [sys.executable, "-m", "hyperpaint", "view", "lot.zarr", "--no-browser"]
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    first = process.stdout.readline()
    address = re.match(r"(http://localhost:\d+/[\w-]{43}/) shows lot\.zarr; Ctrl-C ends it", first)
    assert address, first + process.communicate()[0]
    with process:
        yield Served(address[1], folder, process)
        if process.poll() is None:
            process.kill()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    # Chromium without a window
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium to drive")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


def opened(browser: Any, served: Served, width: int = 1400, query: str = "") -> Any:
    # Return a page once its picture is there, of which errors fail the test
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.problems = []
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.goto(served.address + query)
    # pixels are square, once the size of the figure is known there
    page.get_by_text(re.compile(r"true colour, lines 0 to (\d|1\d)\b")).wait_for(timeout=60_000)
    return page


def move_to(page: Any, along: float, across: float) -> tuple[float, float]:
    x, y = page.evaluate(PLACE_OF, [along, across])
    page.mouse.move(x, y, steps=3)
    return x, y


def click(page: Any, along: float, across: float, *, is_double: bool = False) -> None:
    (page.mouse.dblclick if is_double else page.mouse.click)(*move_to(page, along, across))
    page.wait_for_timeout(500)  # the next click is none of a double click


def drag(page: Any, start: tuple[float, float], stop: tuple[float, float]) -> None:
    move_to(page, *start)
    page.mouse.down()
    move_to(page, *stop)
    page.mouse.up()


def test_a_line_is_explored_in_a_browser(browser: Any, served: Served) -> None:
    page = opened(browser, served)
    line = hp.open_store(served.folder / "lot.zarr", "flightlines/raw_0")
    # a click has the bits of the pixel
    click(page, 7, 3)
    page.get_by_text("line 7, column 3").wait_for()
    ((name, values),) = page.evaluate(CURVES)
    assert name == "clicked"
    np.testing.assert_array_equal(np.array(values, np.float32), line.paint.pixels(7, 3).reflectance.values)
    click(page, 11, 1)
    page.get_by_text("line 11, column 1: shadow").wait_for()
    # a box becomes a region, with a name
    drag(page, (1.6, 0.7), (9.4, 4.3))
    page.get_by_text(re.compile(r"median of \d+ of 32 pixels")).wait_for()
    page.get_by_role("button", name="Box to region").click()
    page.get_by_text("1 region, not saved").wait_for()
    page.get_by_label("Name").fill("red roof")
    page.get_by_label("Name").press("Enter")
    page.get_by_text("red roof: median").wait_for()
    # another is drawn, and one of its corners is dragged
    page.get_by_role("button", name="Draw").click()
    page.get_by_text("Click the corners of a region").wait_for()
    click(page, 10, 0)
    click(page, 12, 0)
    click(page, 12, 4, is_double=True)
    page.get_by_text("2 regions, not saved").wait_for()
    page.get_by_role("button", name="Edit").click()
    page.get_by_text("drag its corners").wait_for()
    drag(page, (12, 4), (11, 5))
    page.wait_for_function(
        """() => Bokeh.documents[0].get_model_by_name("picture").renderers
        .find(one => one.glyph.type == "Patches").data_source.data.along[1].includes(11)"""
    )
    page.get_by_role("button", name="Save regions").click()
    page.get_by_text("2 regions saved").wait_for()
    regions = hp.read_regions(served.folder / "lot-raw_0-regions.geojson")
    assert regions.names == ("red roof", "region 1")
    assert regions[0].polygon.tolist() == [[1, 2], [4, 2], [4, 9], [1, 9]]
    assert regions[1].polygon.tolist() == [[0, 10], [0, 12], [5, 11]]
    assert regions[0].flightline == "raw_0"
    library = line.paint.signatures(regions, min_pixels=1, members=0)
    assert library["signature"].values.tolist() == ["red roof", "region 1"]
    # the slider is moved by its keys, and flags are shown
    page.locator(".noUi-handle").first.press("ArrowRight")
    page.get_by_text(re.compile(r"\d nm, lines 0 to")).wait_for()
    page.get_by_label(re.compile("^shadow")).check()
    page.wait_for_function(
        """() => Bokeh.documents[0].get_model_by_name("picture").renderers
        .filter(one => one.glyph.type == "ImageRGBA" && one.data_source.data.image.length).length == 3"""
    )
    assert page.problems == []
    # what was drawn outlives the page
    page.reload()
    page.get_by_text("2 regions").wait_for()
    page.close()


@pytest.mark.parametrize("width", [1400, 400])
@pytest.mark.parametrize("colours", ["light", "dark"])
def test_pages_fit_the_screen(browser: Any, served: Served, width: int, colours: str) -> None:
    page = opened(browser, served, width, f"?line=raw_1&colours={colours}")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    ink = page.get_by_role("heading", name="raw_1").evaluate("one => getComputedStyle(one).color")
    assert (int(re.findall(r"\d+", ink)[0]) > 128, page.problems) == (colours == "dark", [])
    page.close()


def test_a_line_that_is_not_there_is_the_first(browser: Any, served: Served) -> None:
    page = opened(browser, served, query="?line=%3Cscript%3E&colours=pink")
    assert page.get_by_role("heading", name="raw_0").is_visible()
    page.close()


def asked(served: Served, path: str, **headers: str) -> tuple[int, str]:
    # Return the status and the body that a request of this machine gets; headers by their words
    address = urlsplit(served.address)
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=30)
    sent = {"Host": f"localhost:{address.port}", **headers}
    if "Upgrade" in headers:
        sent |= {
            "Connection": "Upgrade",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "MTIzNDU2Nzg5MDEyMzQ1Ng==",
        }
    connection.putrequest("GET", path, skip_host=True)
    for name, value in sent.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = "" if answer.status == 101 else answer.read().decode()
    connection.close()
    return answer.status, body


def test_only_the_own_page_is_answered(served: Served) -> None:
    address = urlsplit(served.address)
    token, port = address.path, address.port
    own = f"http://localhost:{port}"
    status, body = asked(served, token)
    assert status == 200
    assert "bokeh" in body.lower()
    (session,) = re.findall(r'"token":"([^"]+)"', body)
    socket = {"Upgrade": "websocket", "Sec-WebSocket-Protocol": f"bokeh, {session}"}
    assert asked(served, f"{token}ws", **socket, Origin=own)[0] == 101
    assert asked(served, f"{token}static/js/bokeh.min.js")[0] == 200
    # as other pages, other users and other machines would ask
    wrong = token[:-2] + ("A" if token[-2] != "A" else "B") + "/"
    foreign = [
        f"http://evil.example:{port}",
        f"http://localhost.evil.example:{port}",
        "null",
        "",
        f"https://localhost:{port}",
    ]
    for path in (
        "/",
        wrong,
        "/ws",
        "/static/js/bokeh.min.js",
        f"/?{token[1:-1]}",
        f"{wrong}ws",
        f"//{token}",
    ):
        assert asked(served, path)[0] == 403, path
        assert asked(served, path, **socket, Origin=own)[0] == 403, path
    for host in (f"evil.example:{port}", f"localhost.evil.example:{port}", "localhost", ""):
        assert asked(served, token, Host=host)[0] in (400, 403), host
        assert asked(served, f"{token}ws", **socket, Origin=own, Host=host)[0] in (400, 403), host
    for origin in foreign:
        assert asked(served, token, Origin=origin)[0] == 403, origin
        assert asked(served, f"{token}ws", **socket, Origin=origin)[0] == 403, origin
    assert asked(served, f"{token}ws", **socket)[0] == 403  # no browser leaves the origin out
    # it listens on this machine alone
    process = psutil.Process(served.process.pid)
    listening = [each.laddr for each in process.net_connections("inet") if each.status == psutil.CONN_LISTEN]
    assert [(place.ip, place.port) for place in listening] == [("127.0.0.1", urlsplit(served.address).port)]


def test_ctrl_c_ends_it_with_one_line(served: Served) -> None:
    served.process.send_signal(signal.SIGINT)
    text, _ = served.process.communicate(timeout=30)
    assert (text.strip(), served.process.returncode) == ("stopped by SIGINT", 130)


def test_ctrl_c_ends_it_where_a_library_loses_the_exception(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = pytest.importorskip("panel")
    hp.to_store(flight().line, tmp_path / "lot.zarr", "flightlines/raw_0")
    stopped: list[Any] = []

    class Loop:
        asyncio_loop = SimpleNamespace(call_soon_threadsafe=stopped.append)
        stop = "the loop's"

        def start(self) -> None:
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)

    server = SimpleNamespace(
        io_loop=Loop(), port=1, _tornado=SimpleNamespace(find_handler=None), start=lambda: None
    )
    monkeypatch.setattr(panel, "serve", lambda *_, **__: server)
    handler = signal.getsignal(signal.SIGINT)
    expect_error(
        KeyboardInterrupt, None, lambda: exploring.serve_explorer(tmp_path / "lot.zarr", announce=print)
    )
    assert stopped == ["the loop's"]
    assert signal.getsignal(signal.SIGINT) is handler


def test_every_store_and_line_has_a_file_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    panel = pytest.importorskip("panel")
    monkeypatch.chdir(tmp_path)
    # of another store: not to be shown, nor replaced
    other = hp.Region("other", [(0, 0), (4, 0), (4, 9)])
    hp.write_regions([other], "raw_0-regions.geojson")
    hp.write_regions([other], "lot-regions.geojson")
    hp.to_store(flight().line, "lot.zarr", "flightlines/raw_0")
    shown: list[Any] = []

    def serve(pages: dict[str, Any], **options: Any) -> Any:
        shown.append(pages["/"])
        raise KeyboardInterrupt

    monkeypatch.setattr(panel, "serve", serve)
    explorers: list[Any] = []
    made = exploring.Explorer
    monkeypatch.setattr(
        exploring,
        "Explorer",
        lambda *given, **named: explorers.append(made(*given, **named)) or explorers[-1],
    )
    expect_error(KeyboardInterrupt, None, lambda: exploring.serve_explorer("lot.zarr", announce=print))
    shown[0]()
    assert explorers[0].regions.names == ()
    explorers[0]._state.add([0, 9, 9], [0, 0, 3])
    # a page that is loaded anew
    shown[0]()
    assert "1 region, not saved" in explorers[1]._widgets.message.object
    explorers[1]._widgets.save_button.clicks += 1
    assert hp.read_regions("lot-raw_0-regions.geojson").names == ("region 1",)
    assert hp.read_regions("raw_0-regions.geojson").names == ("other",)


def test_what_cannot_be_viewed_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = CliRunner().invoke
    hp.to_store(flight().line, tmp_path / "line.zarr")
    absent = run(main, ["view", str(tmp_path / "line.zarr"), "--line", "raw_7"])
    assert absent.exit_code == 2
    assert "no flight line 'raw_7', expected line" in absent.output
    monkeypatch.setitem(sys.modules, "panel", None)
    bare = run(main, ["view", str(tmp_path / "line.zarr")])
    assert bare.exit_code == 2
    assert "python -m pip install 'hyperpaint[interactive]'" in bare.output
