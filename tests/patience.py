"""How long tests wait for what is to happen: a hang, not a limit of speed, as machines can be very slow."""

PATIENCE_S = 1200.0
"""Less than the time that pytest-timeout gives a test."""
