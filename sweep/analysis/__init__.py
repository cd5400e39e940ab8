"""Numbers from results: tables, laws, crossings, comparison with what is published; xarray in, xarray out."""
