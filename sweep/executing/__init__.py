"""Runs blocks: serially, on Dask, guarded."""
