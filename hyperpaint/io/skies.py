"""Sun and sky by other programs: libRadtran, MODTRAN, 6S, CSV; each gives the Dataset of `sky_dataset`.

Columns, marks and words of each format stand in tables above its reader.
"""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from hyperpaint.base import (
    Floats,
    FormatError,
    Problem,
    Problems,
    SchemaError,
    conversion_factor,
    takes_quantities,
)
from hyperpaint.io.files.reading import number, numbers, read_limited_text, refuse

# Largest file of a sky model [byte].
MAX_SKY_BYTES = 64 << 20

_IRRADIANCE, _RADIANCE = "W m-2 nm-1", "W m-2 sr-1 nm-1"

#: Columns of a CSV table and their units; those that every table has, of the air before the camera, and of
#: radiance by direction.
_LIGHT = {"wavelength": "nm", "direct_normal": _IRRADIANCE, "diffuse": _IRRADIANCE}
_AIR = {"extinction": "m-1", "path_radiance": f"{_RADIANCE} m-1"}
_RADIANCES = {"zenith": "degree", "azimuth": "degree", "radiance": _RADIANCE}
_COLUMNS = _LIGHT | _AIR | _RADIANCES
_OTHER_NAMES = {"sun": "direct_normal", "sky": "diffuse"}
_HEADING = re.compile(r"\s*(\w{1,40})\s*[\[(]([^\[\]()]{1,80})[\])]\s*")


def sky_lines(path: str | Path) -> list[str]:
    # Return the lines of a text file, at most `MAX_SKY_BYTES`; raises `FormatError`.
    content = read_limited_text(Path(path), MAX_SKY_BYTES, "the output of a model of the atmosphere")
    return content.decode("utf-8", "replace").splitlines()


def _cosine(sun_zenith: float) -> float:
    # Return the cosine of the sun's zenith angle [degree]; refuse a sun that is not above the horizon.
    SchemaError.raise_if(
        not 0.0 <= sun_zenith < 90.0,
        f"sun_zenith is {sun_zenith!r}",
        expected="0 to below 90 degrees",
        code="value-out-of-range",
    )
    return float(np.cos(np.radians(sun_zenith)))


def sky_dataset(
    source: str,
    wavelength: Floats,
    direct_normal: Floats,
    diffuse: Floats,
    radiance: tuple[Floats, Floats, Floats] | None = None,
    air: Mapping[str, Floats] | None = None,
) -> xr.Dataset:
    """Return light at the ground as a Dataset, in order of wavelength.

    Parameters
    ----------
    source
        Name of the file or model.
    wavelength : (wavelength,)
        [nm]
    direct_normal, diffuse : (wavelength,)
        Irradiance normal to the beam, and by the sky on level ground [W m-2 nm-1].
    radiance
        Zenith angles (sky_zenith,) and azimuths from the sun (sky_azimuth,) [degree], and the radiance of the
        sky (wavelength, sky_zenith, sky_azimuth) [W m-2 sr-1 nm-1].
    air
        ``extinction`` [m-1] and ``path_radiance`` [W m-2 sr-1 nm-1 m-1] of the air before the camera
        (wavelength,), both or neither.

    Raises
    ------
    FormatError
        Values are not finite or negative, or wavelengths repeat; all are listed.

    Examples
    --------
    >>> nm = np.array([850.0, 450.0])
    >>> sky_dataset("by hand", nm, np.array([0.8, 1.2]), np.array([0.05, 0.3])).diffuse.values
    array([0.3 , 0.05])
    """
    problems = Problems(f"{source}: light at the ground cannot be used", FormatError)
    order = np.argsort(wavelength, kind="stable")
    spectra = {"direct_normal": direct_normal, "diffuse": diffuse, **(air or {})}
    arrays = dict(spectra)
    if radiance is not None:
        arrays["sky_radiance"] = radiance[2]
    problems.raise_if_any(
        (
            wavelength.size < 2 or not (np.diff(wavelength[order]) > 0.0).all(),
            Problem(
                "wavelengths are fewer than two, or repeated",
                expected="two or more different wavelengths",
                code="wavelength-repeated",
            ),
        ),
        *(
            (
                not (np.isfinite(values).all() and (values >= 0.0).all()),
                Problem(
                    f"{name} has values that are negative or not finite",
                    expected="finite values, 0 or above",
                    code="value-out-of-range",
                ),
            )
            for name, values in {"wavelength": wavelength, **arrays}.items()
        ),
        (
            radiance is not None and not all(np.isfinite(angles).all() for angles in radiance[:2]),
            Problem("directions of the sky have angles that are not finite", code="not-finite"),
        ),
    )
    light = xr.Dataset(
        {name: ("wavelength", values[order], {"units": _COLUMNS[name]}) for name, values in spectra.items()},
        {"wavelength": ("wavelength", wavelength[order], {"units": "nm"})},
        {"source": source},
    )
    if radiance is not None:
        dims = ("wavelength", "sky_zenith", "sky_azimuth")
        light["sky_radiance"] = (dims, radiance[2][order], {"units": _RADIANCE})
        angles = {
            dim: (dim, angle, {"units": "degree"}) for dim, angle in zip(dims[1:], radiance, strict=False)
        }
        light = light.assign_coords(angles)
    return light


def read_sky_csv(path: str | Path) -> xr.Dataset:
    """Return light at the ground from a CSV table, one row per wavelength and direction.

    Parameters
    ----------
    path
        The first row that is not a comment (``#``) has headings with units: ``wavelength [nm]``,
        ``direct_normal [W m-2 nm-1]`` or ``sun``, ``diffuse [W m-2 nm-1]`` or ``sky``; for radiance by
        direction ``zenith [degree]``, ``azimuth [degree]`` from the sun and ``radiance [W m-2 sr-1 nm-1]``;
        and for the air before the camera ``extinction [m-1]`` and ``path_radiance [W m-2 sr-1 nm-1 m-1]``.
        Other units of the same dimension are converted.

    Raises
    ------
    FormatError
        Headings are missing or unknown, cells are not numbers, or directions differ between wavelengths.
    UnitsError
        The units of a heading have another dimension.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "sky.csv")
    >>> _ = path.write_text('''wavelength [um],direct_normal [mW m-2 nm-1],diffuse [mW m-2 nm-1]
    ... 0.45,1200,300
    ... 0.85,800,50
    ... ''')
    >>> light = read_sky_csv(path)
    >>> light.wavelength.values, light.diffuse.values
    (array([450., 850.]), array([0.3 , 0.05]))
    """
    lines = [line for line in sky_lines(path) if line.strip() and not line.lstrip().startswith("#")]
    with FormatError.instead_of(csv.Error, f"{path}: not a CSV table: $whole", code="text-unreadable"):
        rows = list(csv.reader(lines))
    problems = Problems(f"{path}: not a table of a sky", FormatError)
    headings = [_HEADING.fullmatch(cell.lstrip("\ufeff")) for cell in rows[0]] if rows else []
    names = [_OTHER_NAMES.get(found[1].lower(), found[1].lower()) if found else "" for found in headings]
    unreadable = [cell for cell, name in zip(rows[0] if rows else [], names, strict=True) if not name]
    groups = [_LIGHT, *(group for group in (_AIR, _RADIANCES) if set(group) & set(names))]
    missing = sorted(set().union(*groups) - set(names))
    ragged_rows = [number for number, row in enumerate(rows) if len(row) != len(names)]
    found = (
        f"row {ragged_rows[0] + 1} of {len(rows[ragged_rows[0]])} cells"
        if ragged_rows
        else "no row below the headings"
    )
    problems.raise_if_any(
        (
            unreadable or not set(filter(None, names)) <= set(_COLUMNS),
            Problem(
                f"headings {rows[:1]}"[:200],
                expected=f"names among {', '.join(_COLUMNS)} with units, such as 'wavelength [nm]'",
                code="heading-unreadable",
            ),
        ),
        (missing, Problem(f"columns {missing} are missing, found {names}"[:200], code="column-missing")),
        (
            len(set(names)) < len(names) and not unreadable,
            Problem(f"columns {names}: some are repeated", code="column-repeated"),
        ),
        (
            ragged_rows or len(rows) < 2,
            Problem(found, expected=f"rows of {len(names)}", code="length-mismatch"),
        ),
    )
    values = [numbers(row) for row in rows[1:]]
    unread = next((number for number, row in enumerate(values, start=2) if row is None), 0)
    refuse(
        str(path),
        (
            unread,
            Problem(f"row {unread}: {rows[unread - 1]}"[:200], expected="numbers", code="number-unreadable"),
        ),
    )
    table = np.array(values, np.float64)
    factors = [
        conversion_factor(heading[2].strip(), _COLUMNS[name])
        for heading, name in zip(headings, names, strict=True)
        if heading
    ]
    with np.errstate(over="ignore", invalid="ignore"):  # checked below
        table = table * factors
    wrong_rows = np.flatnonzero(~np.isfinite(table).all(axis=1))
    first = int(wrong_rows[0]) if wrong_rows.size else 0
    refuse(
        str(path),
        (
            wrong_rows.size,
            Problem(f"row {first + 2} {rows[first + 1]}", expected="finite numbers", code="not-finite"),
        ),
    )
    columns = dict(zip(names, table.T, strict=True))
    air = {name: columns[name] for name in _AIR if name in columns}
    if "radiance" not in columns:
        nm, direct_normal, diffuse = (columns[name] for name in _LIGHT)
        return sky_dataset(str(path), nm, direct_normal, diffuse, air=air)
    axes = ("wavelength", "zenith", "azimuth")
    wavelength, first_rows = np.unique(columns["wavelength"], return_index=True)
    zenith, azimuth = np.unique(columns["zenith"]), np.unique(columns["azimuth"])
    shape = wavelength.size, zenith.size, azimuth.size
    order = np.lexsort([columns[name] for name in reversed(axes)])
    # the number is checked first: a grid of scattered directions would be huge
    is_grid = math.prod(shape) == order.size and np.array_equal(
        np.stack([columns[name][order] for name in axes]),
        np.stack(np.meshgrid(wavelength, zenith, azimuth, indexing="ij")).reshape(3, -1),
    )
    refuse(
        str(path),
        (
            not is_grid,
            Problem(
                f"{order.size} rows",
                expected=f"every direction once at every wavelength, {shape}",
                code="grid-mismatch",
            ),
        ),
    )
    return sky_dataset(
        str(path),
        wavelength,
        columns["direct_normal"][first_rows],
        columns["diffuse"][first_rows],
        (zenith, azimuth, columns["radiance"][order].reshape(shape)),
        {name: values[first_rows] for name, values in air.items()},
    )


# ----------------------------------------------------------------------------------------------------------
# Irradiance from MODTRAN's ``tape7``, by the radiance of a grey ground of known reflectance.


_TAPE7_COLUMNS = ("FREQ", "TOT_TRANS", "GRND_RFLT", "DRCT_RFLT")
#: Column names of two words in MODTRAN 4 and 5, of one word in 6.
_TWO_WORDS = (
    "TOT TRANS", "PTH THRML", "THRML SCT", "THRML EM", "SURF EMIS", "SOL SCAT", "SING SCAT", "SNGL SCAT",
    "MULT SCAT", "GRND RFLT", "DRCT RFLT", "TOTAL RAD", "REF SOL", "DIR EM", "TOA SUN",
)  # fmt: skip

# Mark below the last row.
_END_MARK = -9999.0


@takes_quantities(sun_zenith="degree")
def read_tape7(path: str | Path, *, sun_zenith: float, ground: float) -> xr.Dataset:
    r"""Return light at the ground from a ``tape7`` in radiance mode (IEMSCT 2) over wavenumbers.

    Parameters
    ----------
    path
        File with a line of names FREQ [cm-1], TOT_TRANS, GRND_RFLT and DRCT_RFLT [W cm-2 sr-1 / cm-1].
    sun_zenith
        Zenith angle of the sun at the ground [degree].
    ground
        Reflectance of the ground in the run, the same at all wavelengths, above 0 (``SURREF``).

    Returns
    -------
    Dataset
        See `sky_dataset`.

    Raises
    ------
    FormatError
        The line of names is missing, as in ``.7sc`` and in runs over wavelengths, whose columns and units
        differ: such files are refused.
    SchemaError
        The sun is not above the horizon, or the ground reflects nothing.

    Notes
    -----
    .. math:: E = \pi L_{GRND} / (\rho T), \quad E_{dir} = \pi L_{DRCT} / (\rho T), \quad
              L_\lambda = 10^{-3} \nu^2 L_\nu

    with L per m2 and nm (L. Guanter et al., Int. J. Remote Sens. 30, 1407 (2009), has the same sums).

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "tape7")
    >>> _ = path.write_text('''  1 5 0 6
    ... FREQ TOT_TRANS THRML_EM THRML_SCT SURF_EMIS MULT_SCAT SING_SCAT GRND_RFLT DRCT_RFLT
    ... 22222.0 0.8 1e-9 9e-9 8e-9 2e-9 1e-9 1.70e-7 1.23e-7
    ... 11765.0 0.8 1e-9 9e-9 8e-9 2e-9 1e-9 2.76e-7 2.54e-7
    ... -9999.
    ... ''')
    >>> light = read_tape7(path, sun_zenith=60.0, ground=0.3)
    >>> light.wavelength.values.round(), light.direct_normal.values.round(2), light.diffuse.values.round(2)
    (array([450., 850.]), array([1.59, 0.92]), array([0.3 , 0.04]))
    """
    cosine = _cosine(sun_zenith)
    SchemaError.raise_if(
        not 0.0 < ground <= 1.0,
        f"ground {ground!r}",
        expected="above 0, at most 1",
        code="value-out-of-range",
    )
    lines = sky_lines(path)
    name_line, heading = next(((n, line) for n, line in enumerate(lines) if "FREQ" in line), (0, ""))
    for name in _TWO_WORDS:
        heading = heading.replace(name, name.replace(" ", "_"))
    names = heading.split()
    FormatError.raise_if(
        not set(_TAPE7_COLUMNS) <= set(names),
        f"{path}: no line of names with {', '.join(_TAPE7_COLUMNS)}",
        expected="a tape7 over wavenumbers",
        mend="run MODTRAN with IEMSCT 2 and spectral units of cm-1, and give its tape7; give direct and "
        "diffuse light as CSV instead of a .7sc",
        code="model-output-wrong",
    )
    rows = []
    for count, line in enumerate(lines[name_line + 1 :], name_line + 2):
        row = numbers(line.split())
        if row is not None and row[:1] == [_END_MARK]:
            break
        if row is None or len(row) < len(names):
            raise FormatError(
                f"{path}: line {count}: {line[:60]!r}",
                expected=f"{len(names)} numbers or {_END_MARK:g}",
                code="number-unreadable",
            )
        rows.append(row[: len(names)])
    else:
        raise FormatError(
            f"{path} ends without the mark {_END_MARK:g}: it was cut short",
            mend="copy it again",
            code="file-truncated",
        )
    table = dict(zip(names, np.array(rows, np.float64).reshape(-1, len(names)).T, strict=True))
    has_light = (table["FREQ"] > 0.0) & (table["TOT_TRANS"] > 1e-6)
    wavenumber, transmittance = table["FREQ"][has_light], table["TOT_TRANS"][has_light]
    with np.errstate(over="ignore", invalid="ignore"):  # checked by sky_dataset
        scale = np.pi * 1e-3 * wavenumber**2 / (ground * transmittance)
        total, direct = scale * table["GRND_RFLT"][has_light], scale * table["DRCT_RFLT"][has_light]
        diffuse = np.where(
            np.abs(total - direct) <= 1e-5 * total, 0.0, total - direct
        )  # rounding of the file
        normal, wavelength = direct / cosine, 1e7 / wavenumber
    return sky_dataset(str(path), wavelength, normal, diffuse)


# ----------------------------------------------------------------------------------------------------------
# Output of libRadtran's ``uvspec`` with the solver disort and its default columns.


_UVSPEC_COLUMNS = 7  # lambda edir edn eup uavgdir uavgdn uavgup


@takes_quantities(sun_zenith="degree", sun_azimuth="degree")
def read_uvspec(
    path: str | Path, *, sun_zenith: float, units: str, sun_azimuth: float = 0.0, directions: int = 0
) -> xr.Dataset:
    """Return light at the ground from an output of ``uvspec``.

    Parameters
    ----------
    path
        Lines ``lambda edir edn eup uavgdir uavgdn uavgup``, the default of disort, at one output level. With
        ``umu`` and ``phi`` in its input, each is followed by a line of the azimuths and by lines ``umu u0u
        uu(phi)``.
    sun_zenith, sun_azimuth
        ``sza`` and ``phi0`` of its input [degree].
    units
        Units of its irradiance, equal to those of the source file, such as "mW m-2 nm-1"; the output lacks
        them.
    directions
        Number of ``umu`` in its input, 0 for none. Directions with umu < 0 look up at the sky; a ``phi``
        of ``phi0`` looks towards the sun.

    Returns
    -------
    Dataset
        See `sky_dataset`.

    Raises
    ------
    FormatError
        Lines have another form (``output_user``, another solver): such files are refused.
    SchemaError
        The sun is not above the horizon, ``directions`` is not a whole number from 0 on, or ``units`` are not
        units of spectral irradiance.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "uvspec.out")
    >>> _ = path.write_text('''450.0 500.0 180.0 61. 79. 45. 12.
    ... 850.0 420.0 40.0 61. 79. 45. 12.
    ... ''')
    >>> light = read_uvspec(path, sun_zenith=60.0, units="mW m-2 nm-1")
    >>> light.direct_normal.values.round(2), light.diffuse.values.round(2)
    (array([1.  , 0.84]), array([0.18, 0.04]))
    """
    cosine, factor = _cosine(sun_zenith), conversion_factor(units, _IRRADIANCE)
    SchemaError.raise_if(
        isinstance(directions, bool) or not isinstance(directions, int | np.integer) or directions < 0,
        f"directions is {directions!r}",
        expected="a whole number from 0 on",
        code="value-out-of-range",
    )
    lines = [line for line in sky_lines(path) if line.strip() and not line.startswith("#")]
    rows = [numbers(line.split()) or [] for line in lines]
    step = 1 if directions == 0 else 2 + directions
    blocks = [rows[start : start + step] for start in range(0, len(rows), step)]
    width = next((len(block[0]) for block in blocks if len(block[0]) != _UVSPEC_COLUMNS), _UVSPEC_COLUMNS)
    refuse(
        str(path),
        (
            not rows or len(rows) % step or [] in rows,
            Problem(
                f"{len(rows)} lines",
                expected=f"{step} lines of numbers for each wavelength",
                mend=(
                    "pass the number of umu in the input of uvspec as directions=; write one output level "
                    "(zout)"
                ),
                code="length-mismatch",
            ),
        ),
        (
            width != _UVSPEC_COLUMNS,
            Problem(
                f"a line of {width} numbers",
                expected=f"{_UVSPEC_COLUMNS}: lambda edir edn eup uavgdir uavgdn uavgup",
                mend="run uvspec with rte_solver disort and without output_user",
                code="model-output-wrong",
            ),
        ),
    )
    table = np.array([block[0] for block in blocks], np.float64)
    light = table[:, 0], factor * table[:, 1] / cosine, factor * table[:, 2]
    if not directions:
        return sky_dataset(str(path), *light)
    # a line of azimuths, and lines of umu, u0u and the radiance at every azimuth
    azimuths = blocks[0][1]
    differ = Problem(
        "blocks of radiance differ",
        expected=f"a line of phi and {directions} of umu u0u uu",
        code="grid-mismatch",
    )
    are_alike = all(
        block[1] == azimuths and {len(row) for row in block[2:]} == {len(azimuths) + 2} for block in blocks
    )
    refuse(str(path), (not are_alike, differ))
    radiance = np.array([block[2:] for block in blocks], np.float64)
    upward = radiance[0, :, 0]
    refuse(
        str(path),
        (
            (radiance[:, :, 0] != upward).any() or not -1.0 <= upward.min() < 0.0,
            Problem(
                f"umu {upward.tolist()}",
                expected="the same at all wavelengths, some from -1 to 0",
                code="grid-mismatch",
            ),
        ),
    )
    sky_directions = np.flatnonzero(upward < 0.0)[::-1]  # from the zenith downwards
    sky_directions = sky_directions[np.argsort(-upward[sky_directions])[::-1]]
    zenith = np.degrees(np.arccos(-upward[sky_directions]))
    from_sun = (np.array(azimuths) - sun_azimuth) % 360.0
    return sky_dataset(str(path), *light, (zenith, from_sun, factor * radiance[:, sky_directions, 2:]))


# ----------------------------------------------------------------------------------------------------------
# Output of 6S: one monochromatic run per wavelength.


#: Words above the row of irradiances on level ground [W m-2 micron-1]: direct, atmosphere, environment.
_SIXS_HEADING = "direct solar irr."
_WAVELENGTH = re.compile(r"monochromatic calculation at wl\s*[:=]\s*([0-9.]+)\s*micron")


@takes_quantities(sun_zenith="degree")
def read_sixs(paths: Sequence[str | Path], *, sun_zenith: float) -> xr.Dataset:
    """Return light at the ground from the outputs of 6S, one monochromatic run per file.

    Parameters
    ----------
    paths
        Files with "monochromatic calculation at wl" [micron] and, under "irr. at ground level
        (w/m2/mic)", "direct solar irr.", "atm. diffuse irr." and "environment irr" on level ground.
    sun_zenith
        Zenith angle of the sun in the runs [degree].

    Returns
    -------
    Dataset
        See `sky_dataset`; ``diffuse`` includes atmosphere and environment.

    Raises
    ------
    FormatError
        A file lacks these lines, as runs over a filter do, which print sums over wavelengths.
    SchemaError
        The sun is not above the horizon.

    Examples
    --------
    >>> import tempfile
    >>> run = '''* monochromatic calculation at wl : {} micron *
    ... *        irr. at ground level (w/m2/mic)            *
    ... * direct solar irr. atm. diffuse irr. environment irr *
    ... *         {}           {}           4.000 *
    ... '''
    >>> paths = [Path(tempfile.mkdtemp(), name) for name in ("450.txt", "650.txt")]
    >>> _ = paths[0].write_text(run.format("0.450", 500.0, 180.0))
    >>> _ = paths[1].write_text(run.format("0.650", 700.0, 100.0))
    >>> light = read_sixs(paths, sun_zenith=60.0)
    >>> light.direct_normal.values.round(3), light.diffuse.values.round(3)
    (array([1. , 1.4]), array([0.184, 0.104]))
    """
    cosine = _cosine(sun_zenith)
    table = []
    for path in paths:
        lines = sky_lines(path)
        wavelength = next((match[1] for line in lines if (match := _WAVELENGTH.search(line))), "")
        heading = next((n for n, line in enumerate(lines[:-1]) if _SIXS_HEADING in line), len(lines))
        micron, row = number(wavelength), (lines[heading + 1 :] or [""])[0]
        values = numbers(row.replace("*", " ").split())
        refuse(
            str(path),
            (
                not wavelength or heading == len(lines),
                Problem(
                    "not a monochromatic run of 6S with irradiance at ground level",
                    mend="run 6S with a single wavelength (IWAVE -1) per file",
                    code="model-output-wrong",
                ),
            ),
            (
                micron is None,
                Problem(
                    f"a wavelength of {wavelength[:60]!r}",
                    expected="a number [micron]",
                    code="number-unreadable",
                ),
            ),
            (
                len(values or ()) != 3,
                Problem(
                    f"line {heading + 2}: {row[:60]!r}",
                    expected="three irradiances",
                    code="number-unreadable",
                ),
            ),
        )
        table.append([micron, *(values or ())])
    micrometres, direct, diffuse, environment = np.array(table, np.float64).reshape(-1, 4).T
    per_nm = 1e-3
    return sky_dataset("6S", 1000.0 * micrometres, per_nm * direct / cosine, per_nm * (diffuse + environment))
