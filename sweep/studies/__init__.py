"""From a study file to a validated Study."""
