"""Options of commands: from functions, few, alike everywhere; old spellings name the new ones."""

import inspect
import re

import click
import pytest
from click.shell_completion import ShellComplete
from support.commands import hyperpaint

import hyperpaint as hp
from hyperpaint.base.errors import SchemaError
from hyperpaint.base.facts import PARAMETERS
from hyperpaint.cli.options import Settings, parameters_of
from hyperpaint.cli.program import GROUPS, main
from hyperpaint.pictures.exploring import serve_explorer
from hyperpaint.workflows import pipeline

CONTEXT = click.Context(main)
NAMES = main.list_commands(CONTEXT)


def options_of(name: str) -> list[click.Option]:
    command = main.get_command(CONTEXT, name)
    assert command is not None
    return [option for option in command.params if isinstance(option, click.Option)]


def run(*words: str) -> str:
    # Return the message of a refused call
    return hyperpaint(*words, status=2).stderr


def test_the_number_of_options() -> None:
    assert len(NAMES) == 22
    assert sum(len(options_of(name)) for name in NAMES) <= 200


def test_help_of_the_program_is_one_screen() -> None:
    shown = hyperpaint("--help").stdout
    assert 24 <= len(shown.splitlines()) <= 42
    for group, commands in GROUPS.items():
        assert re.search(rf"^  {group} ", shown, re.MULTILINE)
        for name in commands:
            assert re.search(rf" {name} ", shown)


@pytest.mark.parametrize("name", NAMES)
def test_help_of_a_command_teaches(name: str) -> None:
    shown = hyperpaint(name, "--help", terminal_width=100).stdout
    assert len(shown.splitlines()) <= 64
    assert f"  hyperpaint {name}" in shown
    assert all(option.help for option in options_of(name))


def test_choices_and_defaults_are_those_of_the_function() -> None:
    parameters = inspect.signature(pipeline.process).parameters
    for option in options_of("process"):
        name = str(option.name)
        if not option.multiple and name != "out":
            assert parameters[name].default == option.default, name
    (layout,) = (option for option in options_of("process") if option.name == "layout")
    assert isinstance(layout.type, click.Choice)
    assert tuple(layout.type.choices) == ("cube", "explore", "web")


def test_shared_descriptions_are_read_from_their_table() -> None:
    process = parameters_of("workflows.pipeline:process")
    assert process["scheduler"].help.startswith("Address of a dask.distributed scheduler")
    assert process["overwrite"].help == PARAMETERS["group overwrite"]


def test_parameters_are_read_without_an_import() -> None:
    found = parameters_of("workflows.maps:location_of")
    assert found["boresight"].kind == {"nargs": 3, "type": float}
    assert isinstance(found["column_order"].kind["type"], click.Choice)
    assert found["ground"].help == "Height of level ground above the ellipsoid [m]."
    assert found["flightline"].default is ...


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("report x --signatures", "--library"), ("site x --signatures", "--library"),
        ("render x --paints", "--library"), ("view x --group", "--line"), ("report x --lines", "--max-lines"),
        ("validate x --plot", "--picture"), ("calibrate x --report", "--picture"),
        ("simulate x --sky", "--atmosphere"), ("detect x --rate", "--false-alarm-rate"),
        ("simulate x --no-noise", "--set noise=no"), ("simulate x --smile", "--set smile_nm=VALUE"),
        ("orthorectify x --boresight", "--set boresight=VALUE,VALUE,VALUE"),
        ("signatures x --glint", "--set glint=VALUE"),
    ],
)  # fmt: skip
def test_an_old_spelling_names_the_new_one(old: str, new: str) -> None:
    message = run(*old.split(), "1")
    assert f"is now {new} [option-renamed]" in message


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("smil=1", "did you mean smile_nm=1? [setting-unknown]"), ("noise", "[setting-unknown]"),
        ("cloud=1,2", "[type-wrong]"), ("smile_nm=wide", "[type-wrong]"), ("noise=perhaps", "[type-wrong]"),
    ],
)  # fmt: skip
def test_a_wrong_setting(setting: str, message: str) -> None:
    assert message in run("simulate", "x", "--set", setting)


def test_settings_are_listed() -> None:
    (settings,) = (option for option in options_of("simulate") if isinstance(option, Settings))
    shown = hyperpaint("simulate", "x", "--set", "?", status=0)
    assert all(re.search(rf"^{name} ", shown.stdout, re.MULTILINE) for name in settings.types)


def test_a_misspelt_command_is_suggested() -> None:
    assert "did you mean signatures?" in run("sigantures")


def test_options_of_the_program_stand_anywhere(tmp_path: object) -> None:
    for words in (
        ["--memory-limit", "much", "report", "."],
        ["report", ".", "--quiet", "--memory-limit=much"],
    ):
        assert "much" in run(*words)


def test_words_are_completed() -> None:
    complete = ShellComplete(main, {}, "hyperpaint", "_HYPERPAINT_COMPLETE")
    assert [item.value for item in complete.get_completions([], "sig")] == ["signatures"]
    assert "--false-alarm-rate" in [item.value for item in complete.get_completions(["detect"], "--f")]


def test_a_renamed_keyword_names_the_new_one() -> None:
    with pytest.raises(SchemaError, match=r"library= .keyword"):
        hp.render_scene("scene.toml", "scene.zarr", paints="paints.zarr")  # type: ignore[call-arg]
    with pytest.raises(SchemaError, match=r"line= .keyword"):
        serve_explorer("lot.zarr", group="raw_0", announce=print)  # type: ignore[call-arg]
    for function in (hp.report.write_report, hp.report.write_site):
        with pytest.raises(SchemaError, match=r"library= .keyword"):
            function("lot.zarr", "page", signatures="paints.zarr")  # type: ignore[call-arg]
        with pytest.raises(SchemaError, match=r"max_lines= .keyword"):
            function("lot.zarr", "page", lines=100)  # type: ignore[call-arg]
