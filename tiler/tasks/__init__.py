"""Tasks: how a layer is cut into them, running one, and the records that resume, update and repair rest on."""
