"""Faults that the inputs of a flight line may have: every kind with its name, weight and mend."""

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
        Whether processing stops, since results would be wrong; else it goes on with a warning.
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
        "The picture is noise, and smooth with the two bytes of every count exchanged.",
        "mend `byte order` in the header of the cube",
    ),
    Kind(
        "interleave",
        "Neighbouring bands look alike in another interleave, but not in the declared one.",
        "mend `interleave` in the header of the cube",
    ),
    Kind(
        "band-order",
        "The absorption bands of daylight (oxygen at 760 nm, and all others) are in other bands than "
        "wavelengths and gains give, or neighbouring bands have nothing in common.",
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
        "The pattern of the dark is not part of the scene: it belongs to another camera, binning or order of "
        "columns or bands.",
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
        "All spectra of irradiance are bit-identical, or stay so over the whole line: the spectrometer had "
        "stopped.",
        "name the record of this flight, with spectra measured during the line",
    ),
    Kind(
        "irradiance-level",
        "Irradiance is a small part or a multiple of a clear sky's at the place and time.",
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
        "Positions or angles are missing for a good part of the lines.",
        "name the navigation of this flight; check its clock",
        refused=False,
    ),
)
#: Every kind of finding, by its name.
KINDS = {kind.name: kind for kind in _ROWS}


@dataclass(frozen=True)
class Finding:
    """One fault of a flight line that is impossible, or nearly so.

    Attributes
    ----------
    kind
        Its row in `KINDS`.
    line
        Flight line, or the cube of one.
    found, expected
        With the figures.
    """

    kind: Kind
    line: str
    found: str
    expected: str

    def __str__(self) -> str:
        return str(self.problem())

    def problem(self, *, acceptable: bool = False) -> Problem:
        """Return it as a `Problem`; an ``acceptable`` one names the option that accepts it."""
        name, mend = self.kind.name, self.kind.mend
        option = mend
        if acceptable:
            mend, option = f"{mend}, or pass accept=[{name!r}]", f"{mend}, or pass --accept {name}"
        return Problem(f"{self.line}: {self.found}", self.expected, mend, option, code=name)
