"""Faults of the inputs of a flight line: kinds of fault with names and remedies, and findings."""

from __future__ import annotations

from dataclasses import dataclass

from hyperpaint.base.errors import Problem


@dataclass(frozen=True)
class Kind:
    """A kind of finding.

    Attributes
    ----------
    name
        Name by which it is listed and accepted; its error code.
    meaning
        Fault of the inputs.
    mend
        Remedy.
    refused
        Whether processing stops, because results would be wrong; otherwise a warning is given.
    """

    name: str
    meaning: str
    mend: str
    refused: bool = True


_ROWS = (
    Kind(
        "counts-over-range",
        "Counts are above the highest count of the camera's converter.",
        "set bit_depth in [camera], or shift left-justified counts down",
    ),
    Kind(
        "stray-counts",
        "A few elements hold counts above the highest count of the camera's converter.",
        "nothing if a frame counter or status word is in the picture: its elements are flagged saturated",
        refused=False,
    ),
    Kind(
        "byte-order",
        "Spectra are noise as stored, and smooth with the two bytes of every count exchanged.",
        "mend `byte order` in the header of the cube",
    ),
    Kind(
        "interleave",
        "Neighbouring bands are similar in another interleave, but not in the declared one.",
        "mend `interleave` in the header of the cube",
    ),
    Kind(
        "band-order",
        "Absorption bands of daylight (such as oxygen at 760 nm) are not in the bands that wavelengths and "
        "gains predict, or neighbouring bands are uncorrelated.",
        "mend the order of the bands in cube and dark, or name the calibration of this camera and binning",
    ),
    Kind(
        "dark-of-zeros",
        "Elements of the dark are exactly zero in every frame.",
        'record the dark again; for dark-corrected counts write cubes = "none" in [dark]',
    ),
    Kind(
        "dark-over-scene",
        "The dark is brighter than the scene.",
        "name the dark of this exposure and gain, recorded with the lens capped",
    ),
    Kind(
        "dark-lit",
        "The dark holds light: its spectrum follows the scene's.",
        "record the dark again with the lens capped",
    ),
    Kind(
        "dark-unsteady",
        "The frames of the dark differ: some are blank, or lit.",
        "leave these frames out of the dark cube",
    ),
    Kind(
        "dark-pattern",
        "The scene does not contain the fixed pattern of the dark, which belongs to another camera, binning "
        "or order of columns or bands.",
        "name the dark of this camera, in the same binning and orientation",
    ),
    Kind(
        "first-frame",
        "The number in the cube's name is not the number of its first frame.",
        "name the frame index of this cube; nothing for a renamed cube",
        refused=False,
    ),
    Kind(
        "foreign-frame-index",
        "The frame index belongs to another cube.",
        "name the frame index of this cube",
    ),
    Kind(
        "doubled-frames",
        "Lines repeat the line before them bit for bit, although noise makes frames differ.",
        "leave these lines out of regions; places and times after them may be late",
        refused=False,
    ),
    Kind(
        "lost-frames",
        "Frames are missing, although the frame index counts them or does not mention them.",
        "check the frame index against the cube; times and places may be wrong from there on",
        refused=False,
    ),
    Kind(
        "irradiance-constant",
        "All spectra of irradiance are bit-identical, or those during the line are: the spectrometer had "
        "stopped.",
        "name the record of this flight, with spectra measured during the line",
    ),
    Kind(
        "irradiance-level",
        "Irradiance is far below or far above that of a clear sky at the place and time.",
        "check the units of the record (units in [irradiance]), its receptor, its time and the line's place",
    ),
    Kind(
        "navigation-still",
        "The platform does not move along the line.",
        "name the navigation of this flight, or none",
        refused=False,
    ),
    Kind(
        "navigation-gaps",
        "Positions or angles are missing for many lines.",
        "name the navigation of this flight; check its clock",
        refused=False,
    ),
    Kind(
        "navigation-convention",
        "The picture of a line contradicts a declared sign, order or reference of the navigation.",
        "check this declaration in [navigation], and [geometry] ground",
        refused=False,
    ),
    Kind(
        "navigation-clock",
        "The picture of a line is early or late against the navigation, or against the irradiance record.",
        "set clock_offset_s of this record, or stamp",
        refused=False,
    ),
)
#: Every kind of finding, by its name.
KINDS = {kind.name: kind for kind in _ROWS}


@dataclass(frozen=True)
class Finding:
    """A fault found in the inputs of a flight line.

    Attributes
    ----------
    kind
        Its row in `KINDS`.
    line
        Name of the flight line or cube.
    found, expected
        Measured and accepted values, in words.
    """

    kind: Kind
    line: str
    found: str
    expected: str

    def __str__(self) -> str:
        return str(self.problem())

    def problem(self, *, acceptable: bool = False) -> Problem:
        """Return the finding as a `Problem`; ``acceptable`` adds the option that accepts it."""
        name, mend = self.kind.name, self.kind.mend
        option = mend
        if acceptable:
            mend, option = f"{mend}, or pass accept=[{name!r}]", f"{mend}, or pass --accept {name}"
        return Problem(f"{self.line}: {self.found}", self.expected, mend, option, code=name)
