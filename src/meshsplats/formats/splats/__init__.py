"""Splat formats of their own: SPZ, SOG and .splat."""
