from .exploring import explore as explore
from .paint_cards import paint_card as paint_card
from .plot import (
    quicklook as quicklook,
    rgb as rgb,
)
from .plot_calibration import calibration_report as calibration_report
from .plot_chain import (
    straightening as straightening,
    triptych as triptych,
)
from .plot_detections import detection_curve as detection_curve
from .plot_flags import (
    adjacency_figure as adjacency_figure,
    flag_overlay as flag_overlay,
)
from .plot_panels import panel_figure as panel_figure
from .plot_renders import chips_and_renders as chips_and_renders
from .plot_spectra import (
    library_overview as library_overview,
    spectrum as spectrum,
)
from .plot_validation import validation_figure as validation_figure
