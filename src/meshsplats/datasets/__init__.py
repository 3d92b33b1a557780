"""Readers of data sets, one module a folder layout. See :mod:`meshsplats.dataset`."""
