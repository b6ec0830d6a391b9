"""The part of the viewer that talks to OpenGL; all of it belongs to one thread."""
