"""Recordings as data sets: streams, grids, readers, splits, and how inputs went between samples."""
