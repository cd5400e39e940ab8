"""A run from plan to results, points computed again, and progress and status for people."""
