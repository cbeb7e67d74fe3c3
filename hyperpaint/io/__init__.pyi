from .dirsig import write_dirsig_scene as write_dirsig_scene
from .envi.envi_cube_writing import write_envi as write_envi
from .flightline.line_table import write_line_table as write_line_table
from .maps.geotiff import write_geotiff as write_geotiff
from .navigation.control_points import read_control_points as read_control_points
from .spectrometers.spectrum_csv import read_certificate as read_certificate
from .store import encoding as encoding
