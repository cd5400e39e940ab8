"""Runs a study from plan to results, computes points again, and shows progress and status."""
