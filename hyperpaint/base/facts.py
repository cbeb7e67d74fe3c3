"""Facts declared once: name, unit, kind, range, default and meaning of a value.

From the same declarations come the checks of settings and of TOML files with their messages, the comments of
templates, the Attributes section of docstrings and the tables of keys in the documentation.
"""

from __future__ import annotations

import dataclasses
import datetime
import inspect
import re
import textwrap
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeGuard, TypeVar

import numpy as np
import xarray as xr

from .errors import PaintError, Problems, SchemaError
from .units import takes_quantities

#: Smallest magnitude that counts as infinite.
MAX_NUMBER = 1e300

#: Maximum length of a value in a message.
MAX_SHOWN_CHARS = 60

_Class = TypeVar("_Class", bound=type)
_Function = TypeVar("_Function", bound=Callable[..., Any])


# --- checks of single values -------------------------------------------------------------------------------


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite number, or an array of one without dims; bool and NaN are not.

    Examples
    --------
    >>> is_number(3), is_number(True), is_number("3"), is_number(float("nan")), is_number(10**400)
    (True, False, False, False, False)
    """
    if isinstance(value, np.ndarray | xr.DataArray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    try:
        return abs(float(value)) < MAX_NUMBER
    except OverflowError:  # a whole number that no float can hold
        return False


def is_text(value: object) -> TypeGuard[str]:
    # Return whether a value is text with at least one visible character.
    return isinstance(value, str) and bool(value.strip())


def one_of(
    value: object,
    allowed: Collection[str],
    name: str,
    *,
    problems: Problems | None = None,
    error: type[PaintError] = SchemaError,
) -> bool:
    """Return whether a value is one of the allowed words; otherwise note it in ``problems``, or raise.

    Parameters
    ----------
    value
        The word.
    allowed
        All words that are accepted.
    name
        The argument or key, as the user spells it.
    problems
        List that receives the fault; None raises it.
    error
        Class of the error raised.

    Examples
    --------
    >>> one_of("cubic", ("linear", "cubic"), "method")
    True
    >>> one_of("cube", ("linear", "cubic"), "method")
    Traceback (most recent call last):
    hyperpaint.base.errors.SchemaError: method='cube', expected one of linear, cubic [choice-unknown]
    """
    if isinstance(value, str) and value in allowed:
        return True
    found, expected = f"{name}={shown(value)}", f"one of {', '.join(allowed)}"
    if problems is None:
        raise error(found, expected=expected, code="choice-unknown")
    problems.add(found, expected=expected, code="choice-unknown")
    return False


def shown(value: object) -> str:
    try:
        text = str(value) if isinstance(value, datetime.date | datetime.time) else repr(value)
    except ValueError:  # Python prints no integer of over 4300 digits; a hexadecimal number can have more
        text = "a number of thousands of digits"
    return text if len(text) <= MAX_SHOWN_CHARS else f"{text[: MAX_SHOWN_CHARS - 3]}..."


# --- declarations ------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Fact:
    """Declaration of one value: an argument in Python, and a key of a TOML file.

    Attributes
    ----------
    doc
        Meaning, as one clause without unit and full stop.
    kind
        "number", "whole" (a whole number), "numbers" (a list), "flag", "choice", "text", "texts" (a text or a
        list of them), "words" (a list of texts, also empty), "time", "table" or "own" (see ``accepts``).
    unit
        CF spelling; empty for pure numbers and words.
    default
        Value of an absent key or argument; None for no default.
    least, most
        Range of numbers, both included; None is open.
    above, below
        Whether ``least`` and ``most`` themselves are excluded.
    choices
        Accepted words.
    length
        Length of "numbers"; 0 accepts any from 1 on.
    single
        Whether "numbers" also accepts a single number.
    optional
        Whether None is accepted.
    needed
        Whether the key must be present.
    name, key
        Spelling in Python, and in a TOML file where it differs (with the unit as suffix).
    scale
        Factor from the number in the file to the argument; None takes numbers unchanged.
    accepts, phrase
        Check of an "own" value, and the accepted values in words; ``phrase`` replaces the text made from
        range and choices for other kinds as well.
    example
        Value that the mend shows where there is no default.

    Examples
    --------
    >>> share = Fact(doc="share of taken bays", kind="number", least=0.0, most=1.0, default=0.85)
    >>> share.fault(0.5), share.fault(2.0), share.fault("much"), share.expected
    (None, 'value-out-of-range', 'type-wrong', 'a number from 0 to 1')
    """

    doc: str
    kind: str = "text"
    unit: str = ""
    default: Any = None
    least: float | None = None
    most: float | None = None
    above: bool = False
    below: bool = False
    choices: tuple[str, ...] = ()
    length: int = 0
    single: bool = False
    optional: bool = False
    needed: bool = False
    name: str = ""
    key: str = ""
    scale: float | None = None
    accepts: Callable[[Any], bool] | None = None
    phrase: str = ""
    example: Any = None

    @property
    def expected(self) -> str:
        if self.phrase:
            return self.phrase
        phrases = {
            "number": f"a number{self._range()}",
            "whole": f"a whole number{self._range()}",
            "numbers": f"{self.length} numbers{self._range()}",
            "flag": "true or false",
            "choice": f"one of {', '.join(self.choices)}",
            "text": "a text",
            "texts": "a text or a list of texts",
            "words": f"a list of some of {', '.join(self.choices)}" if self.choices else "a list of texts",
            "time": "a date or time",
            "table": "a table of texts",
        }
        if self.single:
            return f"{phrases['number']}, or a list of {self.length or 'such'} numbers"
        return phrases[self.kind]

    def _range(self) -> str:
        low, high = (f"{end:g}" if isinstance(end, float) else str(end) for end in (self.least, self.most))
        lower = "" if self.least is None else f" {'above' if self.above else 'from'} {low}"
        if self.most is None:
            return lower
        if self.above:
            return f"{lower} and {'below' if self.below else 'at most'} {high}"
        return f"{lower} to {'below ' if self.below else ''}{high}"

    def fault(self, value: Any) -> str | None:
        # Return the code of the fault of a value, or None for an accepted one.
        if value is None and self.optional:
            return None
        if isinstance(value, np.ndarray) and self.kind == "numbers":
            value = value.tolist()
        if self.kind == "number" or (self.single and not isinstance(value, list | tuple)):
            return self._number_fault(value)
        if self.kind == "whole":
            is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
            return "type-wrong" if not is_whole else None if self._inside(value) else "value-out-of-range"
        if self.kind == "numbers":
            if not isinstance(value, list | tuple):
                return "type-wrong"
            if len(value) != self.length if self.length else not value:
                return "length-mismatch"
            return next(filter(None, map(self._number_fault, value)), None)
        if self.kind == "choice":
            return None if value in self.choices else "choice-unknown"
        if self.kind == "words" and self.choices and isinstance(value, list | tuple):
            return None if all(word in self.choices for word in value) else "choice-unknown"
        tests: Mapping[str, Callable[[Any], bool]] = {
            "flag": lambda value: isinstance(value, bool),
            "text": is_text,
            "texts": lambda value: all(map(is_text, value if isinstance(value, list) and value else [value])),
            "words": lambda value: isinstance(value, list | tuple) and all(map(is_text, value)),
            "time": lambda value: isinstance(value, str | datetime.date),
            "table": lambda value: isinstance(value, dict),
        }
        return None if (self.accepts or tests[self.kind])(value) else "type-wrong"

    def _number_fault(self, value: Any) -> str | None:
        if is_number(value):
            return None if self._inside(value) else "value-out-of-range"
        is_infinite = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        return "not-finite" if is_infinite else "type-wrong"

    def _inside(self, value: Any) -> bool:
        if self.least is not None and (value < self.least or (self.above and value == self.least)):
            return False
        return self.most is None or not (value > self.most or (self.below and value == self.most))

    @property
    def mend(self) -> str:
        # Remedy for a wrong value in a file.
        if self.default is not None:
            return f"leave the key out for {toml_text(self.default)}"
        if self.example is not None:
            return f"for example {self.key or self.name} = {toml_text(self.example)}"
        return "correct it" if self.needed else "correct it, or leave the key out"

    def note(self, problems: Problems, found: str, value: Any, mend: str = "") -> bool:
        # Return whether a value is accepted; otherwise note it, with ``found`` as the user wrote it.
        code = self.fault(value)
        if code is not None:
            problems.add(found, expected=self.expected, mend=mend, code=code)
        return code is None

    def in_file(self) -> Fact:
        # Return the declaration of the key: range and default in the unit of the file.
        if self.scale is None or self.scale == 1.0:
            return self
        ends = {name: getattr(self, name) for name in ("least", "most", "default")}
        ends = {name: float(f"{end / self.scale:.12g}") for name, end in ends.items() if end is not None}
        return dataclasses.replace(self, **ends)

    def argument(self, value: Any) -> Any:
        # Return the argument in Python for a checked value of the file; None stays.
        if value is None:
            return None
        if isinstance(value, list) and self.kind == "numbers":
            return tuple(map(float, value))
        if self.kind == "numbers":
            return float(value)
        if self.kind == "time":  # TOML's own times as text that numpy reads
            return str(value).replace(" ", "T")
        if self.scale == 1.0:
            return float(value)
        return value if self.scale is None else float(f"{value * self.scale:.12g}")


#: Declarations by name, or by key of a TOML table.
Facts = Mapping[str, Fact]


def toml_text(value: Any) -> str:
    # Return a value as a TOML file spells it.
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    return f"[{', '.join(map(toml_text, value))}]" if isinstance(value, list | tuple) else f"{value!r}"


def fact(default: Any, doc: str, kind: str = "", **options: Any) -> Any:
    """Return a dataclass field with its declaration; the kind follows from the default unless given.

    A field with `dataclasses.MISSING` as its default must be given.

    Examples
    --------
    >>> @dataclass
    ... class Light:
    ...     zenith: float = fact(25.0, "zenith angle of the sun", unit="degree", least=0.0, most=89.0)
    >>> problems = Problems("the light cannot be used", SchemaError)
    >>> check_fields(Light(-1.0), problems)
    >>> print(*problems)
    zenith=-1.0, expected a number from 0 to 89 [value-out-of-range]
    """
    if not kind:
        kinds = {bool: "flag", int: "whole", float: "number", tuple: "numbers"}
        kind = "choice" if options.get("choices") else kinds.get(type(default), "text")
    known = None if default is dataclasses.MISSING else default
    return dataclasses.field(
        default=default,
        metadata={"fact": Fact(doc=doc, kind=kind, default=known, optional=default is None, **options)},
    )


def facts_of(owner: Any) -> dict[str, Fact]:
    return {
        field.name: dataclasses.replace(field.metadata["fact"], name=field.name)
        for field in dataclasses.fields(owner)
        if "fact" in field.metadata
    }


def by_key(facts: Iterable[Fact]) -> dict[str, Fact]:
    # Return declarations by the keys of a TOML table, in the units of the file.
    return {declaration.key or declaration.name: declaration.in_file() for declaration in facts}


def argument_facts(function: Callable[..., Any], facts: Iterable[Fact]) -> dict[str, Fact]:
    # Return declarations by argument, with the defaults of a function; they complete its docstring.
    parameters = inspect.signature(function).parameters
    complete = {}
    for entry in facts:
        default = parameters[entry.name].default
        complete[entry.name] = dataclasses.replace(entry, default=default, optional=default is None)
    documented(**{name: described(entry) for name, entry in complete.items()})(function)
    return complete


def filled(facts: Facts, values: Mapping[str, Any]) -> dict[str, Any]:
    # Return the value of every key: that of a file, or the default.
    return {key: values.get(key, declared.default) for key, declared in facts.items()}


def arguments_of(facts: Facts, values: Mapping[str, Any]) -> dict[str, Any]:
    # Return the arguments in Python for checked values of a file by key.
    return {facts[key].name: facts[key].argument(value) for key, value in values.items()}


#: Returns a name and its value as the user wrote them.
Spelling = Callable[[str, Any], str]


def as_argument(name: str, value: Any) -> str:
    # Return an argument as Python spells it.
    return f"{name}={shown(value)}"


def check_values(
    facts: Facts, values: Mapping[str, Any], problems: Problems, spelled: Spelling = as_argument
) -> None:
    # Note every value that the declaration of its name does not accept.
    for name, value in values.items():
        facts[name].note(problems, spelled(name, value), value)


def check_fields(settings: Any, problems: Problems, spelled: Spelling = as_argument) -> None:
    # Note every field of a dataclass whose value its declaration does not accept.
    facts = facts_of(settings)
    check_values(facts, {name: getattr(settings, name) for name in facts}, problems, spelled)


# --- docstrings and tables ---------------------------------------------------------------------------------


def declared(cls: _Class) -> _Class:
    # Complete a dataclass from its facts: docstring section Attributes, and pint quantities as arguments.
    #
    # Fields without a fact are described in the class's own section Attributes, which is continued.
    facts = facts_of(cls)
    entries = "".join(f"{name}\n    {described(fact)}\n" for name, fact in facts.items())
    doc = inspect.cleandoc(cls.__doc__ or "")
    section = re.search(r"^Attributes\n-+\n(?:.+\n)*", doc, re.MULTILINE)
    following = re.search(r"^(?:Raises|Notes|References|Examples)\n-+$", doc, re.MULTILINE)
    end = section.end() if section else following.start() if following else len(doc)
    heading = "" if section else "Attributes\n----------\n"
    before, after = doc[:end].rstrip("\n"), doc[end:].lstrip("\n")
    cls.__doc__ = f"{before}{'' if section else chr(10)}\n{heading}{entries}\n{after}"
    return takes_quantities(**{name: fact.unit for name, fact in facts.items() if fact.unit})(cls)


def described(declaration: Fact) -> str:
    # Return the meaning, unit and accepted values of a declaration as one line.
    unit = f" [{declaration.unit}]" if declaration.unit else ""
    accepted = (
        "" if declaration.kind in ("flag", "text") and not declaration.phrase else f"; {declaration.expected}"
    )
    optional = ", or None" if declaration.optional and accepted else ""
    return f"{declaration.doc[:1].upper()}{declaration.doc[1:]}{unit}{accepted}{optional}."


def key_line(facts: Facts, key: str, value: Any = None, note: str = "") -> str:
    """Return the line of a TOML file for a key, with its meaning, or ``note``, as the comment.

    Without a value it is an optional key: commented out, with its default or an example.

    Examples
    --------
    >>> facts = {"gap_s": Fact(doc="longest gap", kind="number", unit="s", default=2.0)}
    >>> key_line(facts, "gap_s", 3.0), key_line(facts, "gap_s")
    ('gap_s = 3.0  # longest gap [s]', '# gap_s = 2.0  # longest gap [s]')
    """
    declaration = facts[key]
    unit = f" [{declaration.unit}]" if declaration.unit else ""
    choices = f"; one of {', '.join(declaration.choices)}" if declaration.choices else ""
    hint = declaration.example if declaration.default is None else declaration.default
    text = toml_text(hint if value is None else value)
    return f"{'# ' if value is None else ''}{key} = {text}  # {note or f'{declaration.doc}{unit}{choices}'}"


#: Descriptions of the parameters that many functions share, by parameter or by a name of the meaning.
PARAMETERS = {
    "axes": "matplotlib axes to draw on, whose figure is returned; a new figure by default.",
    "clock_offset_s": "Added to ``time`` to have the time of the navigation's clock [s].",
    "codec": (
        '``"compact"`` shuffles bits before lz4; ``"fast"`` shuffles bytes, which takes half the processor '
        "time for a seventh (counts) to two fifths (rounded reflectance) more space. Values and content are "
        "equal: a complete group is not rewritten for another codec."
    ),
    "columns": "Number of paints side by side.",
    "crs": 'Map whose north ``"grid"`` headings count from, where the convention names none.',
    "dataset": (
        "A flight line with ``reflectance``, or with the variables that `hyperpaint.reflectance` needs."
    ),
    "diffuse, sun_zenith": "Direct/diffuse split, see `hyperpaint.surroundings.survey`.",
    "effects": (
        "Fields of `hyperpaint.simulation.SweepSettings`: ``monochromator_fwhm_nm``, ``stray_light`` ...; "
        "and, of the camera, those of `hyperpaint.simulation.SimulationSettings`: ``smile_nm``, "
        "``srf_shape``, ``noise`` ... ``quantise=False`` leaves counts that are not whole."
    ),
    "exclude": "Flags of pixels of regions to exclude; by default as in `hyperpaint.extract_signatures`.",
    "flightlines": 'Names of the flight lines shown, such as ``["raw_0"]``; by default the first 64.',
    "folder": "A folder, new or empty.",
    "kwargs": 'Passed to `xarray.open_zarr`, such as ``chunks={"along_track": 256}``.',
    "latitude, longitude": "Place, north and east positive [degree].",
    "library": (
        "A paint library: ``reflectance`` (signature, band) [1], ``wavelength`` (band) [nm], such as from "
        "`hyperpaint.extract_signatures` or `hyperpaint.open_library`."
    ),
    "line": "A flight line with ``reflectance`` (along_track, band, cross_track) [1] and ``wavelength``.",
    "lines": "Maximum picture height [lines]; longer flight lines are subsampled.",
    "located": "Result of `hyperpaint.geometry.locate`.",
    "location": "Options of `hyperpaint.geometry.locate`, for lines that are not located.",
    "material": "Material of the surface, with its coat and flakes.",
    "overwrite": "Replace the output where it exists.",
    "path": "The file.",
    "picture": "File for the picture (PNG, PDF, ...); none by default.",
    "figure width": "Width of a new figure [inch].",
    "progress": "Called with the number of steps (lines, paints, slabs ...) done, and of all.",
    "rules": "Thresholds of the comparison.",
    "scheduler": (
        "Address of a dask.distributed scheduler, whose workers see the same files. By default the client "
        "that is active, else threads."
    ),
    "spectra": (
        "Holds ``reflectance`` [1], on ``band`` and any other dims, and ``wavelength``; a paint library too."
    ),
    "store": "A finished store, as `hyperpaint.process` or `hyperpaint.render_scene` writes it, or of a map.",
    "sun_zenith": "Zenith angle of the sun [degree]; by default from time and position of each line.",
    "tile": "Rows and columns of a task.",
    "variable": "Name; by default the first of ``reflectance``, ``radiance``, ``counts``, ``values``.",
    "width": "Width of the figure [inch].",
    # descriptions that decorators name
    "group overwrite": "Replace groups that were made from other inputs or parameters.",
    "library page": (
        "A paint library beside the store, as ``hyperpaint signatures`` writes it; libraries in the store "
        "are always shown."
    ),
    "opaque library": "A paint library: ``reflectance`` (signature, band) [1], of opaque paints.",
    "own overwrite": "Replace an earlier output of the same kind; never anything else.",
    "progress bar": "Show a progress bar.",
    "stderr progress": "Show on stderr what is being done, and how far it is.",
    "survey progress": "See `hyperpaint.surroundings.survey`; used without ``model``.",
}


def _indented(text: str) -> str:
    return textwrap.fill(text, 106, initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)


def documented(**descriptions: str) -> Callable[[_Function], _Function]:
    """Return a decorator that fills in parameters of a numpydoc docstring that have no description.

    Parameters
    ----------
    **descriptions
        Description of a parameter, or a key of `PARAMETERS`; takes precedence over `PARAMETERS`.

    Examples
    --------
    >>> @documented()
    ... def save(overwrite: bool = False) -> None:
    ...     \"\"\"Save.
    ...
    ...     Parameters
    ...     ----------
    ...     overwrite
    ...     \"\"\"
    >>> save.__doc__.splitlines()[-1].strip()
    'Replace the output where it exists.'
    """
    texts = PARAMETERS | {name: PARAMETERS.get(text, text) for name, text in descriptions.items()}

    def decorated(function: _Function) -> _Function:
        before, heading, after = inspect.cleandoc(function.__doc__ or "").partition(
            "\nParameters\n----------\n"
        )
        if heading:
            end = re.search(r"^\S.*\n---", after, re.MULTILINE)
            section, rest = (after[: end.start()], after[end.start() :]) if end else (after, "")
            # the line after an entry without description is not indented
            filled = re.sub(
                r"^(\S.*)$(?!\n )",
                lambda entry: f"{entry[1]}\n{_indented(texts[entry[1].lstrip('*')])}",
                section,
                flags=re.MULTILINE,
            )
            function.__doc__ = f"{before}{heading}{filled}{rest}"
        return function

    return decorated
