"""The reference client: geometry and texture clipmaps of a dataset, in a window or headless.

Everything but ``viewer.gl`` works without OpenGL.
"""
