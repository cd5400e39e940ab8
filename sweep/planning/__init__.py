"""From a Study to the blocks of work that are still missing."""
