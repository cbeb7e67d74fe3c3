"""One signature and its references on common bands, with what may be wrong with both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hyperpaint.base.arrays import Floats
from hyperpaint.base.schema import BAND

from .common_bands import Operator, bands_of, operator_onto
from .pairing import Pair
from .result import MEANINGS
from .spectra import Measured

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Compared", "compare"]


DRAWS = 1000
"""Draws of the uncertainty: it is known to 2 % itself."""


@dataclass(frozen=True, eq=False)
class Compared:
    """A pair on common bands.

    Attributes
    ----------
    pair
    bands
        The spectrum whose channels are the common bands.
    signature, reference : (band,)
        Reflectance [1]; NaN where not known.
    onto
        How references, and last the signature, were brought there.
    errors
        Draws of both (draw, band); None where nothing is known of either's.
    """

    pair: Pair
    bands: Measured
    signature: Floats
    reference: Floats
    onto: tuple[Operator, ...]
    errors: tuple[Floats, Floats] | None

    @property
    def names(self) -> str:
        """Names of the references."""
        return ", ".join(each.name for each in self.pair.references)

    @property
    def instrument(self) -> str:
        """Instrument of the references."""
        return self.pair.references[0].instrument

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """Bands that are compared (band,)."""
        return np.isfinite(self.signature) & np.isfinite(self.reference)

    @property
    def coverage(self) -> Floats:
        """Part of each band's response that all sides see (band,)."""
        return np.asarray(np.min([each.coverage for each in self.onto], axis=0))

    @property
    def ranges(self) -> str:
        """What each side sees, as a text."""
        return ", ".join(
            f"{each.name} {each.wavelength[0]:g} to {each.wavelength[-1]:g} nm"
            for each in (self.pair.signature, *self.pair.references)
        )

    def part(self, edges: tuple[float, float]) -> npt.NDArray[np.bool_]:
        """Tell which bands are in a part of the spectrum."""
        return (self.bands.wavelength >= edges[0]) & (self.bands.wavelength < edges[1])

    @property
    def overlap(self) -> str:
        """What was done where the references' detectors overlap."""
        return _common([each.overlap for each in self.pair.references])

    @property
    def matched(self) -> bool:
        """Whether values of any reference were changed to make detectors meet."""
        return any(each.matched for each in self.pair.references)

    @property
    def mirror(self) -> str:
        """Whether the references include the mirror image of the sky."""
        return _common([each.mirror for each in self.pair.references])

    def warnings(self) -> list[str]:
        """Return what a user can act on."""
        messages = []
        name, own, other = self.pair.signature.name, self.pair.signature.mirror, self.mirror
        if {own, other} in ({"included", "excluded"}, {"included", "mixed"}, {"excluded", "mixed"}):
            messages.append(
                f"{name}: the mirror image of the sky is {own} in the signature, {other} in the reference; a "
                "clear coat's adds 0.04 of the share of skylight; see remove_mirrored_sky"
            )
        return messages

    def notes(self) -> tuple[str, ...]:
        """Return what a reader of the result should know."""
        notes = [note for each in self.pair.references for note in each.notes]
        notes += [f"signature: {note}" for note in self.pair.signature.notes]
        if self.matched:
            notes.append(
                "the reference was overlap-matched: below the join of detectors its values were scaled"
            )
        if self.bands is not self.pair.signature:
            notes.append("the signature was brought onto the reference's bands")
        notes += self._left_out()
        notes += self._scales()
        return tuple(dict.fromkeys([*notes, *self._uncertainty()]))

    def _scales(self) -> list[str]:
        """Return that one side is relative to a panel, the other is not."""
        own = self.pair.signature.absolute
        sides = "reference", "signature"
        if all(each.absolute == own for each in self.pair.references):
            return []
        relative, absolute = sides if own else sides[::-1]
        advice = "; pass panel=" if own else ""
        return [
            f"the {relative} is relative to a white panel, the {absolute} is absolute: the panel's own "
            f"reflectance is in the difference{advice}"
        ]

    def _uncertainty(self) -> list[str]:
        """Return what is not known of the uncertainties."""
        own, others = self.pair.signature, self.pair.references
        has_uncertainty = {
            "signature": own.has_uncertainty,
            "reference": len(others) > 1 or others[0].has_uncertainty,
        }
        unknown = [side for side, has in has_uncertainty.items() if not has]
        notes = []
        if unknown:
            notes.append(f"uncertainty without that of the {' and the '.join(unknown)}, which is not known")
        for side, spectra in (("signature", (own,)), ("reference", others)):
            notes += [f"uncertainty of the {side}: {text}" for each in spectra for text in each.gaps()]
        return notes

    @property
    def scatter(self) -> float:
        """How far repeated readings are apart: standard deviation, RMS over the bands compared [1]."""
        spreads = self._spreads()
        if len(self.pair.references) < 2 or not self.used.any():
            return 0.0
        return float(np.sqrt((spreads["reference_sd"][self.used] ** 2).mean()))

    def _left_out(self) -> list[str]:
        """Return how many bands are left out, and why."""
        dull = np.any([~each.seen & np.isfinite(each.noise_gain) for each in self.onto], axis=0)
        reasons = {
            "not seen whole, or without a value": ~self.used & ~dull,
            "sharper than the other side can tell": ~self.used & dull,
        }
        return [
            f"left out of {self.used.size} bands: {int(which.sum())} {reason}"
            for reason, which in reasons.items()
            if which.any()
        ]

    def dataset(self) -> xr.Dataset:
        """Return both spectra on the common bands."""
        import xarray as xr

        columns = {
            "signature": self.signature,
            "reference": self.reference,
            "difference": self.signature - self.reference,
            "coverage": self.coverage,
            **self._spreads(),
        }
        if self.errors is not None:
            for name, errors in zip(("signature_u", "reference_u"), self.errors, strict=True):
                columns[name] = np.sqrt((errors**2).mean(axis=0))
        meanings = {**MEANINGS, "reference": "Reflectance of the reference on common bands"}
        variables = {
            name: (BAND, values, {"units": "1", "long_name": meanings[name]})
            for name, values in columns.items()
        }
        wavelength = (BAND, self.bands.wavelength, {"units": "nm", "long_name": "Centre of the common bands"})
        fwhm = (BAND, self.bands.fwhm, {"units": "nm", "long_name": "Width of the common bands"})
        return xr.Dataset(
            variables,
            {"wavelength": wavelength, "fwhm": fwhm, "used": (BAND, self.used)},
            {"paint": self.pair.signature.name, "reference": self.names, "instrument": self.instrument},
        )

    def _spreads(self) -> dict[str, Floats]:
        """Return the standard deviations of what signature and reference are means of (band,)."""
        spreads = {}
        own, others = self.pair.signature.sd, self.pair.references
        if own is not None:
            spreads["signature_sd"] = self.onto[-1](own)
        if len(others) > 1:
            seen = [use(each.values) for use, each in zip(self.onto[:-1], others, strict=True)]
            spreads["reference_sd"] = np.std(seen, axis=0, ddof=1)
        elif others[0].sd is not None:
            spreads["reference_sd"] = self.onto[0](others[0].sd)
        return spreads


def compare(pair: Pair, seed: int) -> Compared:
    """Bring a pair onto common bands, and draw what may be wrong with it there.

    The draws are the same for every pair, in whatever order they come.
    """
    bands = bands_of(pair.signature, list(pair.references))
    onto = tuple(operator_onto(bands, each) for each in (*pair.references, pair.signature))
    seen = np.stack([use(each.values) for use, each in zip(onto[:-1], pair.references, strict=True)])
    rng = np.random.default_rng(seed)
    has_uncertainty = pair.signature.has_uncertainty or len(seen) > 1 or pair.references[0].has_uncertainty
    errors = None
    if has_uncertainty:
        own = onto[-1](pair.signature.errors(rng, DRAWS))
        errors = own, _errors_of_mean(pair.references, onto[:-1], seen, rng)
    return Compared(pair, bands, onto[-1](pair.signature.values), seen.mean(axis=0), onto, errors)


def _errors_of_mean(
    references: Sequence[Measured], onto: Sequence[Operator], seen: Floats, rng: np.random.Generator
) -> Floats:
    count = len(seen)
    if count == 1:
        return onto[0](references[0].errors(rng, DRAWS))
    away = seen - seen.mean(axis=0)
    errors = np.asarray(rng.standard_normal((DRAWS, count)) @ away / np.sqrt(count * (count - 1.0)))
    # what repetition does not show: readings of one instrument share what is wrong with it
    common = [
        use(each.u_systematic)
        for use, each in zip(onto, references, strict=True)
        if each.u_systematic is not None
    ]
    if common:
        errors += np.mean(common, axis=0) * rng.standard_normal((DRAWS, 1))
    # a few readings may agree by chance
    for use, each in zip(onto, references, strict=True):
        if each.u_random is not None:
            errors += use(each.u_random * rng.standard_normal((DRAWS, each.u_random.size))) / count
    return errors


def _common(words: Sequence[str]) -> str:
    return words[0] if len(set(words)) == 1 else "mixed"
