"""Sunlight on heights: cast shadows and horizons by line sweeps, streamed in bands of rows from the sun's side."""
