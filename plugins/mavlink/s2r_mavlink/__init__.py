"""MAVLink transport and recordings."""
