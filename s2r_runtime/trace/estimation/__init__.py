"""Prediction, noise, likelihood and fits of a composed model, with intervals of its parameters."""
