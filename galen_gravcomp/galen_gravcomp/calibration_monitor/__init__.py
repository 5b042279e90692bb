"""Whether the active calibration still fits, asked live."""
