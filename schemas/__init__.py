"""The shared vocabulary of clipmap: addresses, lattices, regions, manifests, settings and errors.

This package holds plain models and integer geometry only. It imports neither NumPy nor any web framework and does
no I/O, so that every other package (tiler, server, command line, viewer) can afford to import it.
"""
