"""Options of a command, from the parameters of the function that it calls; exit statuses, bars and messages.

The source of the function is parsed, not imported, so that ``--help`` is fast. Annotations give the types:
``Literal`` a choice, ``bool`` a flag, ``tuple[float, float]`` two numbers, ``Collection[str]`` a repeatable
option. Defaults are those of the signature; the help is the first sentence of the parameter in the numpydoc
section, or in `hyperpaint.base.facts.PARAMETERS`. A command overrides them by keywords of `takes`.
"""

import ast
import contextlib
import difflib
import functools
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from hyperpaint.base import as_path, is_plain_file, url_of

if TYPE_CHECKING:
    from hyperpaint.workflows.pipeline import Outcome

_PACKAGE = Path(__file__).parents[1]
_NUMBERS = {"int": int, "float": float}


class PathOrUrl(click.Path):
    # A local path that is checked here, or a URL, which the function that takes it reads.
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = as_path(value)
        return super().convert(path, param, ctx) if url_of(path) is None else path


class CollectPath(PathOrUrl):
    # A ``collect.toml``, or the local folder that holds one.
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        toml = as_path(value) / "collect.toml"
        is_there = url_of(toml) is None and is_plain_file(toml)
        return super().convert(toml if is_there else value, param, ctx)


PLACE = PathOrUrl(path_type=Path)

#: Parameters that are no options of a command, because it or the program passes them.
_HIDDEN = ("progress", "scheduler")

#: Maximum number of names that the help of ``--set`` lists.
MAX_LISTED = 20

#: Spelling, placeholder and help of options that differ from those of the function, by parameter.
OVERRIDES: dict[str, dict[str, Any]] = {
    "accept": {"metavar": "FINDING", "help": "Continue despite this finding of check; repeatable."},
    "boresight": {"metavar": "R P H"},
    "overwrite": {"help": "Replace products of other inputs or parameters."},
    "flightlines": {"spelling": "--line", "metavar": "ID", "help": "Only this flight line; repeatable."},
    "lever_arm": {"metavar": "F R D"},
    "library": {"metavar": "LIBRARY"},
    "picture": {"metavar": "PICTURE", "type": PathOrUrl(dir_okay=False, path_type=Path)},
    "srf_shape": {"spelling": "--shape"},
}


class Parameter(NamedTuple):
    # A parameter of a function, or a field of a dataclass.
    module: str
    annotation: ast.expr | None
    value: ast.expr | None  #: Default; None without.
    help: str

    @property
    def kind(self) -> dict[str, Any]:
        # Attributes of `click.Option` by the annotation.
        return _kind(self.annotation, self.module)

    @property
    def default(self) -> Any:
        # Default value: ``...`` if required, None if it is computed.
        return _value(self.value, self.module)


@functools.cache
def _module_tree(module: str) -> ast.Module:
    path = _PACKAGE.joinpath(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def parameters_of(qualified_name: str) -> dict[str, Parameter]:
    # Return the parameters of a function or dataclass, such as ``"workflows.pipeline:process"``.
    module, _, name = qualified_name.partition(":")
    node: Any = next(node for node in _module_tree(module).body if getattr(node, "name", None) == name)
    # entries of the numpydoc section: names, and the indented text below them
    section = re.search(
        r"^(?:Parameters|Attributes)\n-+\n(.*?)(?=^\w[^\n]*\n-{3}|\Z)",
        ast.get_docstring(node) or "",
        re.M | re.S,
    )
    entries = re.findall(r"^(\S[^\n]*)\n((?:[ ]+[^\n]*\n?|\n)+)", section[1] if section else "", re.M)
    described = {name: _help(text) for names, text in entries for name in re.split(r",\s*", names)}
    # The descriptions that `hyperpaint.base.facts.documented` adds to a function's parameters.
    calls = (call for call in node.decorator_list if isinstance(call, ast.Call))
    decorator = next((call for call in calls if ast.unparse(call.func) == "documented"), None)
    shared: dict[str, str] = {}
    if decorator is not None:
        table: dict[str, str] = _value(ast.Name("PARAMETERS"), "base.facts")
        texts = {word.arg: ast.literal_eval(word.value) for word in decorator.keywords if word.arg}
        shared = table | {name: table.get(text, text) for name, text in texts.items()}
    parameters: dict[str, Parameter] = {}
    if isinstance(node, ast.ClassDef):
        for base in node.bases:
            parameters |= parameters_of(":".join(_defining_module(module, ast.unparse(base))))
        pairs = [
            (field.target.id, field.annotation, field.value)
            for field in node.body
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        ]
        for name, _, call in pairs:  # fields declared as fact(default, doc, ...)
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "fact":
                doc = ast.literal_eval(call.args[1])
                units = [
                    ast.literal_eval(keyword.value) for keyword in call.keywords if keyword.arg == "unit"
                ]
                described[name] = f"{doc[:1].upper()}{doc[1:]}{''.join(f' [{unit}]' for unit in units)}."
    else:
        spec = node.args
        defaults = [None] * (len(spec.args) - len(spec.defaults)) + spec.defaults + spec.kw_defaults
        pairs = [
            (argument.arg, argument.annotation, default)
            for argument, default in zip(spec.args + spec.kwonlyargs, defaults, strict=True)
        ]
    return parameters | {
        name: Parameter(module, annotation, default, described.get(name) or _help(shared.get(name, "")))
        for name, annotation, default in pairs
    }


def _defining_module(module: str, name: str) -> tuple[str, str]:
    for node in _module_tree(module).body:
        # an if statement holds the imports under TYPE_CHECKING
        for statement in node.body if isinstance(node, ast.If) else [node]:
            for alias in statement.names if isinstance(statement, ast.ImportFrom) else ():
                if name == (alias.asname or alias.name):
                    assert isinstance(statement, ast.ImportFrom)
                    parents = module.split(".")[: -statement.level] if statement.level else []
                    home = ".".join([*parents, (statement.module or "").removeprefix("hyperpaint.")])
                    # a room's door hands on the names of its modules
                    for path in sorted(_PACKAGE.joinpath(*home.split(".")).glob("*.py")):
                        if re.search(
                            rf"^(class |def )?{alias.name}\b", path.read_text(encoding="utf-8"), re.M
                        ):
                            return f"{home}.{path.stem}", alias.name
                    return home, alias.name
    return module, name


def _assigned_value(module: str, name: str) -> tuple[ast.expr | None, str]:
    # the expression assigned to a module-level name of this package, and the module of the assignment
    module, name = _defining_module(module, name)
    if not (_PACKAGE / module.split(".")[0]).exists() and not (_PACKAGE / f"{module}.py").exists():
        return None, module
    for node in _module_tree(module).body:
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        if isinstance(node, ast.Assign | ast.AnnAssign) and name in map(ast.unparse, filter(None, targets)):
            return node.value, module
    return None, module


def keys_of(qualified_name: str) -> list[str]:
    # Return the keys of a table at the top of a module, such as ``"workflows.field_day:STEPS"``.
    table = _assigned_value(*qualified_name.split(":"))[0]
    assert isinstance(table, ast.Dict)
    return [ast.literal_eval(key) for key in table.keys if key is not None]


def _value(node: ast.expr | None, module: str) -> Any:
    # the value of a default: ``...`` if there is none, None if it is computed
    if node is None:
        return ...
    if isinstance(node, ast.Name):
        node = _assigned_value(module, node.id)[0]
    try:
        return ast.literal_eval(node) if node is not None else None
    except ValueError:
        return None


def _kind(node: ast.expr | None, module: str) -> dict[str, Any]:
    words = ast.unparse(node) if node is not None else "Any"
    alternatives = [alternative.strip() for alternative in words.split(" | ") if alternative != "None"]
    if "bool" in alternatives:
        return {"is_flag": True}
    if any(alternative.endswith("Path") or "PathLike" in alternative for alternative in alternatives):
        return {"type": PLACE}
    if isinstance(node, ast.BinOp):  # the first type of a union
        return _kind(node.left, module)
    if isinstance(node, ast.Subscript):
        head, inner = ast.unparse(node.value), node.slice
        values = inner.elts if isinstance(inner, ast.Tuple) else [inner]
        if head == "Literal":
            return {"type": click.Choice([ast.literal_eval(value) for value in values])}
        if head == "tuple" and "..." not in words:
            return {"nargs": len(values), "type": _NUMBERS.get(ast.unparse(values[0]), str)}
        if head in ("Collection", "Sequence"):
            return {"multiple": True}
    if isinstance(node, ast.Name) and node.id in _NUMBERS:
        return {"type": _NUMBERS[node.id]}
    if isinstance(node, ast.Name):
        alias, module = _assigned_value(module, node.id)
        if alias is not None:
            return _kind(alias, module)
    return {}


def _help(text: str) -> str:
    # Return the first sentence of a description, and the sentence about its default.
    words = re.sub(r"`?`([^`]+)``?", lambda code: code[1].removeprefix("hyperpaint."), " ".join(text.split()))
    summary, *sentences = re.split(r"(?<=[.])\s", words)
    default = next((sentence for sentence in sentences if sentence.startswith("By default")), "")
    return f"{summary} {default}".strip()


#: Options that are created when their command is called, because they need the source of a function.
Deferred = Callable[[], list[click.Option]]


def _adds(options: Deferred) -> Callable[[Any], Any]:
    def decorate(command: Any) -> Any:
        vars(command).setdefault("__click_params__", []).append(options)
        return command

    return decorate


def takes(
    qualified_name: str,
    *,
    only: Collection[str] = (),
    without: Collection[str] = (),
    **overrides: Mapping[str, Any],
) -> Callable[[Any], Any]:
    # Return a decorator that adds the parameters of a function to a command as options.
    #
    # The first parameter of the function is the argument of the command, not an option. ``only`` and
    # ``without``: names of parameters; ``overrides``: differences from `OVERRIDES` and the function, by
    # parameter.
    def options() -> list[click.Option]:
        parameters = parameters_of(qualified_name)
        names = only or [name for name in list(parameters)[1:] if name not in (*_HIDDEN, *without)]
        return [_option(name, parameters[name], overrides.get(name, {})) for name in names]

    return _adds(options)


def _option(name: str, parameter: Parameter, overrides: Mapping[str, Any]) -> click.Option:
    keywords = {**parameter.kind, "help": parameter.help, **OVERRIDES.get(name, {}), **overrides}
    spelling = keywords.pop("spelling", f"--{name.replace('_', '-')}")
    if parameter.default is ...:
        keywords.setdefault("required", True)
    elif not keywords.get("multiple"):
        keywords.setdefault("default", parameter.default)
    if keywords.get("is_flag") and keywords["default"] is not False:
        spelling = f"{spelling}/--no-{spelling.removeprefix('--')}"
    return click.Option([*spelling.split(" "), name], **keywords)


class Settings(click.Option):
    """The option ``--set NAME=VALUE``: further arguments of functions, parsed by their annotations."""

    def __init__(self, parameters: Mapping[str, Parameter]) -> None:
        self.helps = {name: parameter.help for name, parameter in parameters.items()}
        kinds = {name: parameter.kind for name, parameter in parameters.items()}
        self.types = {
            name: click.Option([f"--{name}"], **({"type": click.BOOL} if kind.get("is_flag") else kind))
            for name, kind in kinds.items()
        }
        names = ", ".join(self.types) if len(self.types) < MAX_LISTED else "any effect"
        super().__init__(
            ["--set", "settings"],
            multiple=True,
            metavar="NAME=VALUE",
            callback=self.parsed,
            help=f"Set {names}; repeatable. --set ? describes the names.",
        )

    def parsed(self, ctx: click.Context, _: click.Parameter, values: tuple[str, ...]) -> dict[str, Any]:
        # Return the values by name, converted to the types of their parameters.
        settings: dict[str, Any] = {}
        for value in values:
            name, equals, text = value.partition("=")
            if name == "?":
                formatter = click.HelpFormatter(width=100)
                formatter.write_dl(list(self.helps.items()))
                click.echo(formatter.getvalue(), nl=False)
                ctx.exit()
            name = name.replace("-", "_")
            if not equals or name not in self.types:
                matches = difflib.get_close_matches(name, self.types, 1)
                mend = (
                    f"did you mean {matches[0]}={text or 'VALUE'}?" if matches else "--set ? lists the names"
                )
                raise click.BadParameter(
                    f"{value!r}, expected NAME=VALUE; {mend} [setting-unknown]", ctx, self
                )
            kind = self.types[name]
            words = re.split(r"[,\s]+", text.strip()) if kind.nargs > 1 else text
            try:
                settings[name] = kind.type_cast_value(ctx, words)
            except click.BadParameter as error:
                raise click.BadParameter(f"{value!r}: {error.message} [type-wrong]", ctx, self) from error
        return settings


def settable(
    names_by_function: Mapping[str, Collection[str]], *, without: Collection[str] = ()
) -> Callable[[Any], Any]:
    # Return a decorator that adds ``--set`` for parameters of functions: the named ones, or all.
    def options() -> list[click.Option]:
        parameters = {
            name: parameter
            for qualified_name, names in names_by_function.items()
            for name, parameter in parameters_of(qualified_name).items()
            if (name in names if names else name not in (*_HIDDEN, *without))
        }
        return [Settings(parameters)]

    return _adds(options)


def suggestion(word: str, words: Iterable[str], otherwise: str = "") -> str:
    """Return a question for the most similar of the words, after a blank.

    Examples
    --------
    >>> suggestion("porcess", ["process", "export"])
    " Did you mean 'process'?"
    """
    matches = difflib.get_close_matches(word, list(words), 1)
    return f" Did you mean {matches[0]!r}?" if matches else otherwise


def unknown_option(error: click.NoSuchOption, ctx: click.Context) -> click.UsageError:
    # The error on an unknown option, in the same words for every version of click
    levels = {id(level): level for level in (ctx, ctx.find_root())}.values()
    parameters = [each for level in levels for each in level.command.get_params(level)]
    names = [name for each in parameters for name in (*each.opts, *each.secondary_opts)]
    text = suggestion(error.option_name, [name for name in names if name.startswith("-")])
    return click.UsageError(f"No such option {error.option_name!r}.{text}", ctx)


class Command(click.Command):
    # A command whose error on an old spelling of an option names the new spelling.
    _params: list[Any]

    def __init__(self, *args: Any, renamed: Mapping[str, str] | None = None, **keywords: Any) -> None:
        super().__init__(*args, **keywords)
        self.renamed = renamed or {}

    @property
    def params(self) -> list[click.Parameter]:
        # Arguments and options; deferred options are created here.
        groups = [[entry] if isinstance(entry, click.Parameter) else entry() for entry in self._params]
        self._params = [parameter for group in groups for parameter in group]
        return self._params

    @params.setter
    def params(self, params: list[Any]) -> None:
        self._params = params

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        # Parse the arguments; an error on an old spelling names the new spelling.
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            word = error.option_name.removeprefix("--").replace("-", "_")
            switch = word.removeprefix("no_")
            settings = next((option for option in self.params if isinstance(option, Settings)), None)
            kinds = {} if settings is None else settings.types
            matches = [
                f"--set {name}={'no' if word != switch else ','.join(['VALUE'] * kind.nargs)}"
                for name, kind in kinds.items()
                if switch in (name, name.rpartition("_")[0]) or name.endswith(f"_{switch}")
            ]
            new_spelling = self.renamed.get(error.option_name) or next(iter(matches), "")
            if not new_spelling:
                raise unknown_option(error, ctx) from error
            raise click.UsageError(
                f"{error.option_name} is now {new_spelling} [option-renamed]", ctx
            ) from error

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        # Write the examples, and the options that all commands take.
        super().format_epilog(ctx, formatter)
        with formatter.indentation():
            formatter.write(
                "\n  Every command also takes --quiet, --memory-limit SIZE and --scheduler ADDRESS (dask).\n"
            )


command = functools.partial(click.command, cls=Command)
FILE = PathOrUrl(dir_okay=False, path_type=Path)
FOLDER = PathOrUrl(file_okay=False, path_type=Path)
EXISTING = PathOrUrl(exists=True, path_type=Path)
EXISTING_FILE = PathOrUrl(exists=True, dir_okay=False, path_type=Path)
COLLECT = CollectPath(exists=True, dir_okay=False, path_type=Path)

#: Exit statuses of a command: data fail a check; the call or an input is wrong.
FAILED_CHECK, WRONG_INPUT = 1, 2

#: Exit status of a command stopped by a signal, minus the number of the signal: 130 for Ctrl-C, 143 for
#: SIGTERM.
SIGNALLED = 128


def program_option(name: str) -> Any:
    # Return the value of an option of the program, such as ``--memory-limit``.
    context = click.get_current_context(silent=True)
    return None if context is None else context.find_root().params.get(name)


def is_watched() -> bool:
    # Return whether progress is shown: on a terminal, without ``--quiet``.
    return sys.stderr.isatty() and not program_option("quiet")


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[Any]:
    # Yield a function of (done, total) that draws a bar on stderr; None if progress is not shown.
    if not is_watched():
        yield None
        return
    bars: list[Any] = []
    with contextlib.ExitStack() as stack:

        def update(done: int, total: int) -> None:
            if not bars:
                bars.append(
                    stack.enter_context(click.progressbar(length=total, label=label, file=sys.stderr))
                )
            bars[0].update(done - bars[0].pos)
            if done >= total:
                stack.close()

        yield update


def beside(source: Path, name: str) -> Path:
    # Return the default path of a product: ``name`` in the folder of its source.
    return source.absolute().parent / name if source.name in ("", ".", "..") else source.with_name(name)


def refuse_if(is_wrong: object, text: str) -> None:
    # Refuse a call with this message (`click.UsageError`), if it is wrong.
    if is_wrong:
        raise click.UsageError(text)


def refuse_in_store(store: Path, *products: Path | None) -> None:
    # Refuse a product inside the store from which it is made (`click.UsageError`).
    for path in filter(None, products):
        refuse_if(
            store.resolve() in (path.resolve(), *path.resolve().parents),
            f"{path} is in the store itself; choose another path [output-in-store]",
        )


def without_none(options: Mapping[str, Any]) -> dict[str, Any]:
    # Return the options that are not None; the function has defaults for other options.
    return {name: value for name, value in options.items() if value is not None}


def say_picture(picture: Path | None, what: str = "it") -> None:
    # Print where a picture was drawn, if one was.
    if picture is not None:
        click.echo(f"look at {what} in {picture}")


def end_with_problems(ctx: click.Context, problems: Iterable[str], text: str) -> None:
    # Print problems of a check on stderr, each after ``text``; if there are any, exit with status 1.
    lines = [f"{text}: {problem}" for problem in problems]
    if lines:
        click.echo("\n".join(lines), err=True)
        ctx.exit(FAILED_CHECK)


def say_outcome(outcome: "Outcome") -> None:
    # Print which groups of a store were written, and which were complete.
    written, unchanged = (
        ", ".join(f"/{group}" for group in groups) for groups in (outcome.written, outcome.unchanged)
    )
    if not written:
        click.echo(f"{outcome.path} is already complete: same inputs, same parameters; nothing was done")
        return
    click.echo(f"{outcome.path}: wrote {written}")
    for group, text in outcome.corrected.items():
        click.echo(f"/{group}: {text}")
    if unchanged:
        click.echo(f"{outcome.path}: {unchanged} there already, from the same inputs")
