"""The version of the tracer."""

VERSION = 6
"""Of the tracer. It rises with every change after which the same rows, model, seed and options can give another answer: an audit recomputes
the answers of this version only. An answer that states no version is of version 1.
"""
