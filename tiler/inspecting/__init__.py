"""What a dataset, a level, a block or a place holds."""
