"""What accuracy costs in time: every kernel and its rivals on one sample of terrain or picture, error against time.

``sample`` cuts the input, ``ideal`` says what a coarser level should be, ``plain`` filters in NumPy, ``response`` reads a kernel's taps;
``experiments``, ``precision`` and ``voids`` measure, ``rivals`` are other programs' filters; ``findings`` says what the figures mean;
``lightexperiments`` and its neighbours measure shadows, horizons, the sun's disc and the sky;
``report`` runs it all and keeps it, ``page`` and ``plots`` show it, ``machine`` says where it was.
"""
