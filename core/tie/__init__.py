"""The link of two real tables: rows with epochs, elimination of the five parameters, outliers, errors, forecasts.

Differences are reference - satellite everywhere; angles are radians and proper motions rad/yr.
"""
