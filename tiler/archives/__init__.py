"""Layers as PMTiles archives, and copies of datasets between stores."""
