"""Files of field spectrometers and irradiance logs: ASD, SVC, text, stores."""
