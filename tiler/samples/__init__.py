"""From source files to the samples of a layer, and what changes samples before the pyramid is built."""
