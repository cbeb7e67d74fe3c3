"""`[[references]]` of a collect: opened with it, kept in its store, and named where they cannot be."""

import re
import shutil
from pathlib import Path

import pytest
from support.refusals import refusal

import hyperpaint as hp
from hyperpaint.base.errors import CollectError
from hyperpaint.workflows.pipeline import run


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("references")
    return hp.simulate_collect(folder, scene="plan", lines=8, bands=6, columns=6, truth=False).parent


@pytest.fixture
def collect(source: Path, tmp_path: Path) -> Path:
    return shutil.copytree(source, tmp_path / "raw") / "collect.toml"


def test_references_are_opened_by_what_they_are(collect: Path) -> None:
    tree = hp.open_collect(collect)
    for name, opened in {"svc": hp.open_svc, "asd": hp.open_asd}.items():
        folder = collect.parent / {"svc": "svc", "asd": "asd_reflectance"}[name]
        assert tree[f"references/{name}"].to_dataset().identical(opened(folder))


def test_a_damaged_reference_is_an_error_that_names_it(collect: Path) -> None:
    (collect.parent / "svc" / "red.sig").write_text("/*** Spectra Vista SIG Data ***/\nunits= ?\n")
    (collect.parent / "asd_reflectance" / "blue.asd").write_bytes(b"as7")
    with pytest.raises(CollectError, match="cannot be processed") as caught:
        hp.open_collect(collect)
    assert "red.sig" in str(caught.value)
    assert "blue.asd" in str(caught.value)


def test_instruments_name_groups(collect: Path) -> None:
    text = collect.read_text()
    for name, told in {
        "../svc": "instrument = '../svc', expected letters",
        "": "instrument = '', expected a text",
        "ASD": "'asd' has another table",
    }.items():
        collect.write_text(text.replace('instrument = "svc"', f'instrument = "{name}"'))
        with pytest.raises(CollectError, match=re.escape(told)):
            hp.open_collect(collect)


def test_an_instrument_may_be_called_by_its_model(collect: Path) -> None:
    text = collect.read_text()
    collect.write_text(text.replace('instrument = "svc"', 'instrument = "SVC HR-1024i"'))
    opened = hp.open_collect(collect)["references/SVC_HR-1024i"].to_dataset()
    assert (opened.attrs["instrument_name"], opened.attrs["instrument"]) == ("SVC HR-1024i", "SVC")
    collect.write_text(text.replace('instrument = "svc"', 'instrument = "SVC HR-1024i"')
                       .replace('instrument = "asd"', 'instrument = "svc_hr-1024i"'))  # fmt: skip
    with refusal(CollectError, "name-duplicate", "'svc_hr-1024i'"):
        hp.open_collect(collect)


def test_instruments_are_not_mixed(collect: Path) -> None:
    text = collect.read_text()
    collect.write_text(
        text.replace('files = "svc/*.sig"', 'files = ["svc/red.sig", "asd_reflectance/red.asd"]')
    )
    with pytest.raises(CollectError, match="instrument-mixed"):
        hp.open_collect(collect)


@pytest.mark.slow
def test_another_reference_is_other_input(collect: Path, tmp_path: Path) -> None:
    # Texts count by what they say: a store is the same in another process, and differs by a name
    out = tmp_path / "lot.zarr"
    assert set(run(collect, out).written) >= {"references/svc", "references/asd"}
    assert run(collect, out).written == ()
    (collect.parent / "svc" / "red.sig").rename(collect.parent / "svc" / "crimson.sig")
    with refusal(hp.StoreError, "store-exists", "/references/svc", "other inputs"):
        run(collect, out)
    assert run(collect, out, overwrite=True).written == ("references/svc",)
    assert "crimson" in hp.open_store(out, "references/svc")["spectrum"].values.tolist()
    assert hp.verify(out).ok
