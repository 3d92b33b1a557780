"""Formats for splats alone: SPZ, SOG and .splat."""
