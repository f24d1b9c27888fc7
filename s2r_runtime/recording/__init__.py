"""The log: written so that a kill cannot empty it, read so that a cut cannot hide."""
