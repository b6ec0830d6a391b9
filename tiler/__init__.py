"""Numbers and bytes: reads sources, filters levels, cuts, encodes and stores blocks."""
