from . import (
    collects as collects,
    demonstration as demonstration,
    field_day as field_day,
    field_folder as field_folder,
    maps as maps,
    pipeline as pipeline,
    rendering as rendering,
)
