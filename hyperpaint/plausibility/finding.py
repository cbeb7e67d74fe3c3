"""What may be wrong with the inputs of a flight line: every kind with its name, weight and mend."""

from __future__ import annotations

from dataclasses import dataclass

from hyperpaint.base.errors import Problem


@dataclass(frozen=True)
class Kind:
    """A kind of finding.

    Attributes
    ----------
    name
        By which it is listed and accepted.
    meaning
        What the inputs show.
    mend
        What to look for.
    refused
        Whether processing stops, since results would be wrong; else it goes on with a warning.
    """

    name: str
    meaning: str
    mend: str
    refused: bool = True


_LIST = (
    Kind(
        "counts-over-range",
        "Counts lie above the last that the converter of the camera gives.",
        "set bit_depth in [camera], or shift left-justified counts down",
    ),
    Kind(
        "stray-counts",
        "A few elements hold counts above the last that the converter of the camera gives.",
        "a frame counter or status word in the picture: its elements are flagged saturated",
        refused=False,
    ),
    Kind(
        "byte-order",
        "The picture is smooth once the two bytes of every count change places, and noise as it is.",
        "mend `byte order` in the header of the cube",
    ),
    Kind(
        "interleave",
        "Neighbouring bands look alike where the samples are read in another interleave, and not as it is.",
        "mend `interleave` in the header of the cube",
    ),
    Kind(
        "band-order",
        "The lines of the daylight (oxygen at 760 nm, and all others) stand in other bands than wavelengths "
        "and gains say, or neighbouring bands have nothing in common.",
        "mend the order of the bands in cube and dark, or name the calibration of this camera and binning",
    ),
    Kind(
        "dark-of-zeros",
        "Elements of the dark are exactly zero in every frame.",
        'record the dark again; where the counts are dark-corrected, say cubes = "none" in [dark]',
    ),
    Kind(
        "dark-over-scene",
        "The dark is brighter than the scene.",
        "name the dark of this exposure and gain, recorded with the lens capped",
    ),
    Kind(
        "dark-lit",
        "The dark holds light: it goes with wavelength as the scene does.",
        "record the dark again with the lens capped",
    ),
    Kind(
        "dark-unsteady",
        "The frames of the dark are not alike: some are blank, or lit.",
        "look at the frames of the dark cube, and leave these out",
    ),
    Kind(
        "dark-pattern",
        "The pattern of the dark is not the one that lies under the scene: it is of another camera, binning "
        "or order of columns or bands.",
        "name the dark of this camera, in the same binning and orientation",
    ),
    Kind(
        "first-frame",
        "The cube is named by a number that is not that of its first frame.",
        "name the frame index of this cube; where the cube was renamed, nothing is to mend",
        refused=False,
    ),
    Kind(
        "foreign-frame-index",
        "The frame index is that of another cube.",
        "name the frame index of this cube",
    ),
    Kind(
        "doubled-frames",
        "Lines are bit for bit those before them; noise makes frames differ.",
        "leave these lines out of regions; places and times after them may be late",
        refused=False,
    ),
    Kind(
        "lost-frames",
        "Frames are missing that the frame index counts as there, or nothing says so.",
        "check the frame index against the cube; times and places may be wrong from there on",
        refused=False,
    ),
    Kind(
        "irradiance-constant",
        "All records of irradiance are the same bits, or they stand still over the whole line: the "
        "spectrometer had stopped.",
        "name the record of this flight; a copied spectrum is not one of its time",
    ),
    Kind(
        "irradiance-level",
        "Irradiance is a small part of a clear sky's at the place and time, or a multiple.",
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
KINDS = {kind.name: kind for kind in _LIST}


@dataclass(frozen=True)
class Finding:
    """One thing about a flight line that cannot be true, or is hardly so.

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
        """Return it as a problem of an error; one that is ``acceptable`` says how it is accepted."""
        name, mend = self.kind.name, self.kind.mend
        option = mend
        if acceptable:
            mend, option = f"{mend}, or pass accept=[{name!r}]", f"{mend}, or pass --accept {name}"
        return Problem(f"{self.line}: {self.found}", self.expected, mend, option, code=name)
