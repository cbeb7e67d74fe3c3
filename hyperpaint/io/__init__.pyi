from .dirsig import write_dirsig_scene as write_dirsig_scene
from .envi.envi_cubes import EnviParser as EnviParser, write_envi as write_envi
from .flightline.flightline_opening import write_line_table as write_line_table
from .flightline.side_files import open_calibration as open_calibration, open_sweep as open_sweep
from .library.library_formats import check_library as check_library, declare_library as declare_library
from .maps.map_grids import write_geotiff as write_geotiff
from .navigation.navigation_records import read_control_points as read_control_points
from .rgl import read_rgl as read_rgl
from .skies import (
    read_sixs as read_sixs,
    read_sky_csv as read_sky_csv,
    read_tape7 as read_tape7,
    read_uvspec as read_uvspec,
)
from .spectrometers.spectrum_csv import (
    read_angular_response as read_angular_response,
    read_certificate as read_certificate,
    read_panel_table as read_panel_table,
    read_radcal as read_radcal,
)
from .store import encoding as encoding
from .store.raw_references import open_virtual as open_virtual
