"""The galaxy search of `sweep match`, a command beside the platform: only this and `sweep.calibrate` import `core`."""
