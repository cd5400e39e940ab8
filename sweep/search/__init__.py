"""The galaxy search of `sweep match`, a command beside the platform."""
