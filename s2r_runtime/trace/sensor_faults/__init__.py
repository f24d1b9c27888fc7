"""Where measurements, not the motion, are wrong: outliers, frozen values, heading, latency."""
