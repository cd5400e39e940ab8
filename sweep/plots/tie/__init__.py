"""Pictures of the link of real tables and of forecasts, from the labelled datasets of `sweep tie` and `sweep forecast`."""
