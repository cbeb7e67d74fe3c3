"""hyperpaint: from raw pushbroom counts to calibrated paint spectra, in labelled, unit-checked xarray."""
