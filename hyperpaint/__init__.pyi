from . import (
    alignment as alignment,
    calibration as calibration,
    geometry as geometry,
    io as io,
    light as light,
    paints as paints,
    pictures as pictures,
    radiometry as radiometry,
    regions as regions,
    report as report,
    simulation as simulation,
    surroundings as surroundings,
    validation as validation,
)
from .base import errors as errors
from .base.attitude_conventions import Convention as Convention
from .base.errors import (
    FormatError as FormatError,
    PaintError as PaintError,
    SchemaError as SchemaError,
    StoreError as StoreError,
    UnitsError as UnitsError,
)
from .base.schema import Quality as Quality
from .calibration import calibrate as calibrate
from .io.dirsig import write_dirsig as write_dirsig
from .io.flightline.flightline_opening import open_flightline as open_flightline
from .io.library import (
    open_library as open_library,
    write_library as write_library,
)
from .io.navigation.navigation_records import open_navigation as open_navigation
from .io.spectrometers.asd import open_asd as open_asd
from .io.spectrometers.irradiance import open_irradiance as open_irradiance
from .io.spectrometers.spectrum_texts import open_svc as open_svc
from .io.store import (
    open_store as open_store,
    to_store as to_store,
    verify as verify,
)
from .light.illumination import Tilt as Tilt
from .paints.signatures import extract_signatures as extract_signatures
from .radiometry.counts_to_reflectance import (
    radiance as radiance,
    reflectance as reflectance,
    slab as slab,
)
from .radiometry.panels import Panel as Panel
from .regions import (
    Region as Region,
    Regions as Regions,
    read_regions as read_regions,
    write_regions as write_regions,
)
from .simulation import simulate_collect as simulate_collect
from .validation import validate as validate
from .workflows.collects import open_collect as open_collect
from .workflows.pipeline import process as process
from .workflows.rendering import render_scene as render_scene

__version__: str
