"""One run from plan to results, coming back to one, and what a person sees of it."""
