"""The compiled core behind ctypes: its library and C structures, losses and the Adam optimiser."""
