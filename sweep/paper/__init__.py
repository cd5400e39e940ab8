"""All of Metz & Geffert 2004: the built-in studies that publish something, and the calibration of its missions."""
