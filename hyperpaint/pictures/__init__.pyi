from .exploring import explore as explore
from .plot import (
    adjacency_figure as adjacency_figure,
    calibration_report as calibration_report,
    chips_and_renders as chips_and_renders,
    detection_curve as detection_curve,
    flag_overlay as flag_overlay,
    library_overview as library_overview,
    paint_card as paint_card,
    panel_figure as panel_figure,
    quicklook as quicklook,
    rgb as rgb,
    scenes_and_spectra as scenes_and_spectra,
    spectrum as spectrum,
    straightening as straightening,
    triptych as triptych,
    validation_figure as validation_figure,
)
