"""Pictures of the link of real tables and of forecasts, from the datasets of `sweep tie` and `sweep forecast`."""
