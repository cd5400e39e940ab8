"""Parameter sweeps on Dask with labelled results in Zarr; `linksweep` for users, ``sweep`` on the command line."""
